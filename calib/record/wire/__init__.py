"""The wire format between devices and host: messages, framing, encoding, decoding, and the order of frames."""

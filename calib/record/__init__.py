"""Record sessions from devices: what devices send becomes a session file, and nothing that arrived is lost.

From the wire to the file: `wire` (messages and the order of frames), `sources` (TCP, serial, replay), `intake` and
`recorder` (threads that only move bytes), `journal` (the file that survives a crash, and its conversion to a session),
`clock` (device time to host time). `priority` gives threads real-time scheduling, and `device` simulates a skin that
uses the same wire format.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

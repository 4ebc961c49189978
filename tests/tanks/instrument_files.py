"""Files of instruments for the chest, written number by number as eidors_readdata of EIDORS describes them.

Frames are (frames, 208), in the order in which the instruments read: drives (d, d + 1), and for each the pairs
(m, m + 1) from m = d + 2 on.
"""

import struct

OLD_TEXT = (
    b"---Draeger EIT-Software---\r\n---Protocol Data-----\r\n\r\nDate:  18-02-2004\r\nTime:  13:18 PM\r\n\r\n"
    b"Frequency [Hz]:      97656.3\r\nGain:                1145\r\nFrames:                10"
)
NEW_TEXT = (
    b"\r\n\r\n*******************************\r\n---Draeger EIT-Software V1.30---\r\n\r\nDate:      01.01.2024\r\n"
    b"Frequency [kHz]:   101.501\r\nFramerate [Hz]:    50\r\nAmplitude [uA]:    9100\r\n\r\n***************************"
)
FACTOR, OTHER_FACTOR, OTHER = 0.00098242, 0.00019607, 25.0


def goe_get(frames, half=False):
    """With ``half``, zero stands for each reading whose reciprocal came before it."""
    raw = b""
    for frame in frames:
        for drive in range(16):
            for step in range(13):
                left_out = half and (drive + 2 + step) % 16 < drive
                raw += struct.pack("<f", 0.0 if left_out else frame[13 * drive + step])
        raw += struct.pack("<16f", *[0.9] * 16) + struct.pack("<16f", *[0.3] * 16) + struct.pack("<16f", *[-0.01] * 16)
    return raw


def goe_half_get(frames):
    return goe_get(frames, half=True)


def draeger_get(frames):
    return OLD_TEXT + b"\r\n\r\n\r\n" + goe_get(frames)


def draeger_eit(frames, version=51, size=5495):
    """The readings as a difference of two sets of which the second is constant."""
    raw = struct.pack("<III", version, 12 + len(NEW_TEXT), 1578) + NEW_TEXT + b"**\r\n\r\n\r\n"
    for number, frame in enumerate(frames):
        one = [(value + OTHER_FACTOR * OTHER) / FACTOR for value in frame]
        parts = (
            struct.pack("<d", 0.757 + 1e-6 * number) + struct.pack("<208d", *one) + struct.pack("<114d", *[7.0] * 114)
        )
        parts += struct.pack("<208d", *[OTHER] * 208) + struct.pack("<70d", *[7.0] * 70)
        raw += parts + bytes(size - len(parts))
    return raw


def older_draeger_eit(frames):
    return draeger_eit(frames, 32, 5200)


def carefusion_eit(frames):
    """Each frame between an image and a waveform, behind a text of two bytes a letter."""
    text = '<?xml version="1.0" ?>\r\n<EIT_File>\r\n<Header>%d bytes</Header>\r\n</EIT_File>\r\n'
    size = 2 + 2 * len(text % 100)
    raw = b"\xff\xfe" + (text % size).encode("utf-16-le")
    for number, frame in enumerate(frames):
        raw += struct.pack("<6i", 7, 0, number, 4, 912, 0) + struct.pack("<912f", *[0.5] * 912)
        raw += struct.pack("<6i", 3, 0, number, 4, 256, 0)
        raw += struct.pack("<47f", *[9.0] * 47) + struct.pack("<208f", *frame) + struct.pack("<f", 9.0)
        raw += struct.pack("<6i", 8, 1, number, 4, 5, 0) + struct.pack("<5f", *[3.0] * 5)
    return raw

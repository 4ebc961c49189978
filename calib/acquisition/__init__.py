"""Recording: what devices send becomes a session file, and nothing that arrived is lost.

From the wire to the file: `wire` (bytes to frames), `clock` (device time to host time), `journal` (what
survives a crash), `finish` (journal to session), `sources` (TCP, serial, replay), `recorder` (threads that
only move bytes), `priority` (woken at once) and `device` (a simulated skin that speaks the same wire).
"""

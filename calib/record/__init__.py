"""Record sessions from devices: what devices send becomes a session file, and nothing that arrived is lost.

From the wire to the file: `wire` (messages and the order of frames), `sources` (TCP, serial, replay), `intake` and
`recorder` (threads that only move bytes), `journal` (the file that survives a crash, and its conversion to a session),
`clock` (device time to host time). `priority` gives threads real-time scheduling, and `device` simulates a skin that
uses the same wire format.

Example:
    import numpy as np

    from calib.record import SimulatedDevice, StopRequest, frame_packets, plan_recording, record_session

    times = range(0, 1_000_000_000, 10_000_000)  # ns: 1 s at 100 Hz
    pads = (np.full(4, 100.0 * k, "f4") for k in range(100))  # Pa
    stop = StopRequest()  # stop.stop_recording() from another thread ends the recording
    with SimulatedDevice([frame_packets(2, times, pads)], wait_for=1) as device:
        url = f"{device.urls[0]}?channels=4"  # of your device: tcp://HOST:PORT or serial:///dev/ttyACM0
        plan, sources = plan_recording({"pressure": url}, skin=None, title="a second of pads")
        summary = record_session(plan, sources, "recorded.h5", seconds=0.5, stop_request=stop)
    print(summary.render())
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

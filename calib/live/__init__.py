"""Live force maps as frames arrive, for people (`page`, `rerun_view`) and for programs (lines of JSON).

A frame passes from the receiving threads (`record`) through `loop` and `engine` to a `FrameResult`, which `loop` hands
to every viewer.

Example:
    import jax

    import calib
    from calib.live import LiveControl, LiveSettings, run_live
    from calib.record import plan_recording, session_journal

    jax.config.update("jax_enable_x64", True)

    mine = calib.load_calibration("calibration.h5")
    # your devices: tcp://HOST:PORT
    urls = {name: "replay://other.h5?speed=10" for name in ("eit", "pressure")}
    plan, sources = plan_recording(urls, mine.skin)
    control = LiveControl()


    def show(result):  # a FrameResult, as each frame arrives
        if result.number % 100 == 0:
            print(f"{result.force.sum():.1f} N, {1e3 * result.latency:.1f} ms after the frame")
        if result.number == 300:
            control.stop.set()


    with session_journal("kept.h5") as journal:  # what arrives is also recorded
        frames = run_live(
            mine, plan, sources, [show], control, LiveSettings(rest=0.3, proposal=None), log=journal
        )
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

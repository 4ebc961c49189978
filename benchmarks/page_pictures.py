"""Pictures of the live page and of a part of the report, SIMULATED, in docs/live.md and docs/report.md.

The live page shows the bundled session of four presses, replayed; the report is that of the other bundled session.

python -m benchmarks.page_pictures      # needs Chromium, as the tests of pages do
"""

import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

import calib
from calib.calibration import Calibration
from calib.live import Engine, ReceivedFrame
from calib.live.loop import LiveControl
from calib.live.views.page import Page
from calib.report.document import write_report
from calib.runtime import set_up
from tests.browser import Browser, browser_path

from .harness import ROOT

SESSIONS = ROOT / "data" / "sessions"
LIVE, REPORT = ROOT / "docs" / "live-page.png", ROOT / "docs" / "report-contacts.png"
MAPS = "document.querySelector('.panels.maps')"
WIDTH, HEIGHT = 1280, 800  # CSS pixels
SKIPPED = 6  # frames for each one that is shown, so that the replay is done in seconds
UNTIL = 18.2  # s, in the third press
REST = 2.0  # s


def frames() -> Iterator[ReceivedFrame]:
    """Frames of the session, each with the pressures before it."""
    with calib.open_session(SESSIONS / "testbed_presses.h5") as session:
        eit, pressure = session.stream("eit"), session.stream("pressure")
        times, values = np.asarray(eit.time), eit.read()
        before = np.clip(np.searchsorted(pressure.time, times) - 1, 0, None)
        pressures = pressure.read()[before]
    for time_of, frame, beside in zip(times, values, pressures, strict=True):
        if time_of - times[0] < UNTIL * 1e9:
            yield ReceivedFrame(np.asarray(frame, float), np.asarray(beside, float), int(time_of - times[0]))


def main() -> None:
    browser = browser_path()
    if browser is None:
        sys.exit("page_pictures: install Chromium, or name a browser of its kind in $JAXEIT_BROWSER")
    set_up()
    with calib.open_session(SESSIONS / "testbed_grid.h5") as session:
        calibration = calib.calibrate([session], recipe=calib.Recipe(location=calib.PadEdge()))
    with Browser(browser) as found:
        LIVE.write_bytes(live_picture(found, calibration))
        REPORT.write_bytes(report_picture(found, calibration))


def live_picture(browser: Browser, calibration: Calibration) -> bytes:
    """The window in the third press; latency is the time that a frame takes here."""
    engine = Engine(calibration, REST)
    with Page(calibration, LiveControl(state="running")) as page, browser.open(page.url, WIDTH, HEIGHT) as tab:
        for k, arrival in enumerate(frames()):
            begin = time.monotonic()
            result = engine.step(arrival)
            latency = time.monotonic() - begin
            engine.use_spare_time(1.0)
            if result is not None and k % SKIPPED == 0:
                page.show_result(replace(result, latency=latency))
                tab.wait_for(f"last && last.number === {result.number}")
        time.sleep(0.5)  # until the histories are drawn
        return tab.screenshot(whole=False)


def report_picture(browser: Browser, calibration: Calibration) -> bytes:
    """Images, force maps and contacts of some presses."""
    with tempfile.TemporaryDirectory() as folder:
        page, *_ = write_report(calibration, Path(folder) / "report.html")
        with browser.open(page.as_uri(), WIDTH, HEIGHT) as tab:
            return tab.screenshot(of=MAPS)


if __name__ == "__main__":
    main()

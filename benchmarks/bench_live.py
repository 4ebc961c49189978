"""Live over loopback: loss, latency from a frame's last byte to its force map, growth of memory, and the highest rate.

The skin is a process of its own that sends frames of 928 readings and 1,000 samples of the pads' pressures a second.

python -m benchmarks.bench_live [--smoke] [--minutes 10] [--calibration CALIBRATION.h5] [--no-rates]
"""

import argparse
import multiprocessing
import os
import sys
import threading
import time
from itertools import count
from multiprocessing.synchronize import Event
from typing import Any

import jax
import numpy as np

import calib
import jaxeit as je
from calib.acquisition.device import Device, Packets, rows
from calib.acquisition.live import Show, live
from calib.acquisition.results import Result
from calib.acquisition.setup import prepare

from ._common import circumstances, write

RATE, PRESSURE_RATE = 100, 1000
REST = 1.0
TRIED = (100, 200, 400, 600, 800, 1000, 1500, 2000)
LOST = 1e-3  # of the frames may be dropped at a rate that is sustained


def main(argv: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="five seconds, two rates, nothing written")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--calibration", help="default: one made up for the chest skin, without correction by place")
    parser.add_argument("--no-rates", action="store_true", help="leave out the search for the highest rate")
    args = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    calibration = calib.load_calibration(args.calibration) if args.calibration else made_up()
    data: dict[str, Any] = {"circumstances": circumstances(), "readings": calibration.recon.readings}
    data["soak"] = watched(calibration, RATE, 5.0 if args.smoke else 60 * args.minutes)
    print(data["soak"], flush=True)
    data["rates"] = []
    for rate in () if args.no_rates else TRIED[:2] if args.smoke else TRIED:
        row = watched(calibration, rate, 3.0 if args.smoke else 15.0)
        data["rates"].append(row)
        print(row, flush=True)
        if row["dropped"] + row["lost"] > LOST * row["frames"]:
            break
    if not args.smoke:
        write("live_located" if args.calibration else "live", data)
    return data


def made_up() -> calib.Calibration:
    """A linear curve for each pad; the image as `calibrate` makes it."""
    skin = je.load_skin("chest")
    recon = je.prepare(je.discretise(je.Scene(skin), je.Fidelity.draft()))
    pressure = np.tile(np.linspace(0, 4000, 64), (len(skin.pads), 1))
    noise = np.random.default_rng(0).normal(0, 0.05, 64)
    curves = calib.fit_curves(calib.Linear(), pressure, 5e-3 * pressure[0] + noise)
    none: Any = None  # nothing was pressed
    return calib.Calibration(skin, recon, je.pad_masks(skin, recon), curves, none, {}, simulated=True)


def skin_process(rates: tuple[int, int], channels: tuple[int, int], urls: Any, stop: Event) -> None:
    """The device, until told to stop."""
    with Device([frames(number + 1, *what) for number, what in enumerate(zip(rates, channels, strict=True))]) as device:
        urls.put(device.urls)
        stop.wait()


def frames(number: int, rate: int, channels: int) -> Packets:
    """Noise; on the pads a press of 2 kPa, half of the time, from two seconds on."""
    rng = np.random.default_rng(number)
    pool = rng.normal(0, 1e-6, (64, channels)).astype("f4")
    pressed = pool + np.float32(2e-4 * rng.normal() if number == 1 else 2000.0)
    times = (n * 1_000_000_000 // rate for n in count())
    choice = ((pressed if n > 2 * rate and n // rate % 2 else pool)[n % 64] for n in count())
    return rows(number, times, choice)


class Watch:
    """Latencies, and the memory of this process once a second."""

    def __init__(self) -> None:
        self.latency: list[float] = []
        self.memory: list[tuple[float, float]] = []
        self.last: Result | None = None

    def __call__(self, result: Result) -> None:
        self.last = result
        self.latency.append(result.latency)
        now = time.monotonic()
        if not self.memory or now - self.memory[-1][0] >= 1.0:
            self.memory.append((now, resident()))


def resident() -> float:
    """MB, of this process."""
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def slope(memory: list[tuple[float, float]]) -> float:
    """MB per hour, over the later four fifths: what start-up takes does not grow on."""
    later = np.array(memory[len(memory) // 5 :])
    return float(3600 * np.polyfit(later[:, 0] - later[0, 0], later[:, 1], 1)[0]) if len(later) > 2 else 0.0


def watched(calibration: calib.Calibration, rate: int, seconds: float) -> dict[str, Any]:
    """One run: what was lost, the latencies in ms, and what memory did."""
    context = multiprocessing.get_context("spawn")
    urls, stop = context.Queue(), context.Event()
    channels = calibration.recon.readings, len(calibration.skin.pads)
    skin = context.Process(target=skin_process, args=((rate, PRESSURE_RATE), channels, urls, stop), daemon=True)
    skin.start()
    try:
        eit, pressure = urls.get(timeout=120)
        show, watch = Show(), Watch()
        timer = threading.Timer(seconds, show.stop.set)
        plan, sources = prepare({"eit": eit, "pressure": pressure}, calibration.skin)
        live(calibration, plan, sources, watch, show, rest=REST, begun=timer.start)
        timer.cancel()
    finally:
        stop.set()
        skin.join(10)
    assert watch.last is not None, "no frame came"
    p50, p99, worst = (1e3 * np.percentile(watch.latency, [50, 99, 100])).tolist()
    return {
        "rate_hz": rate,
        "seconds": round(seconds, 1),
        "frames": watch.last.number,
        "lost": show.lost,
        "dropped": watch.last.dropped,
        "unsearched": watch.last.unsearched,
        "latency_ms_p50": round(p50, 3),
        "latency_ms_p99": round(p99, 3),
        "latency_ms_max": round(worst, 3),
        "memory_mb": round(watch.memory[-1][1]),
        "memory_mb_per_hour": round(slope(watch.memory), 1),
    }


if __name__ == "__main__":
    if os.environ.get("OPENBLAS_NUM_THREADS") != "1":  # read when NumPy is imported; jaxeit live sets it too
        os.environ["OPENBLAS_NUM_THREADS"] = "1"
        os.execv(sys.executable, [sys.executable, "-m", "benchmarks.bench_live", *sys.argv[1:]])
    main()

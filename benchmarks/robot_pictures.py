"""Pictures of what other programs receive, SIMULATED: topics of ROS, frames of LeRobot, a map of firmware.

python -m benchmarks.robot_pictures     # in docs/; needs a C compiler, and jaxeit[tables,foxglove] and websockets
"""

import io
import json
import re
import struct
import subprocess
import tempfile
import time
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import matplotlib.image
import numpy as np

import calib
import jaxeit as je
from calib.calibration.localisation.locators import CentroidLocator
from calib.live.bridges import Bridge, FoxgloveServer
from calib.live.results import FrameResult
from calib.report.figures.parts import write_figure
from calib.runtime import set_up

from .bench_live import made_up
from .figures import panels
from .harness import ROOT

DOCS = ROOT / "docs"
COLOURS = "viridis"


def main() -> None:
    set_up()
    write_figure(ros_picture(), DOCS / "ros-live.png")
    with tempfile.TemporaryDirectory() as folder:
        calibration = located()
        write_figure(lerobot_picture(calibration, Path(folder)), DOCS / "lerobot-frames.png")
        write_figure(firmware_picture(calibration, Path(folder)), DOCS / "firmware-map.png")


def located() -> calib.Calibration:
    """A calibration with a correction by location at the place of the image, of the bundled session."""
    recipe = calib.Recipe(location=calib.PadEdge(), locator=calib.calibration.ImageCentroid())
    with calib.open_session(ROOT / "data" / "sessions" / "testbed_grid.h5") as session:
        return calib.calibrate([session], recipe=recipe)


# --- ROS -------------------------------------------------------------------------------------------------------------


def ros_picture() -> Any:
    """The picture and points of a frame with two contacts on the chest, as a client of Foxglove has them."""
    calibration = made_up()
    messages = received(calibration, frame_of(calibration, ((0.05, 0.08, 12.0), (-0.08, -0.05, 8.0))))
    picture, cloud = messages["/skin/force_map"], messages["/skin/taxels"]
    names = [part.name for part in cloud.fields]
    points = np.frombuffer(bytes(cloud.data), "<f4").reshape(-1, len(names))
    x, y, z, pressure = (points[:, names.index(name)] for name in ("x", "y", "z", "pressure"))
    figure, (left, right) = panels(7.4, 3.2, 1, 2)
    shown = np.frombuffer(bytes(picture.data), "<f4").reshape(picture.height, picture.width)
    left.imshow(1e3 * shown, cmap=COLOURS)
    left.set_title("/skin/force_map, mN on a pixel", fontsize=9)
    left.set_axis_off()
    right.remove()
    space = figure.add_subplot(1, 2, 2, projection="3d")
    drawn = space.scatter(1e3 * x, 1e3 * y, 1e3 * z, c=pressure / 1e3, s=6, cmap=COLOURS)
    space.set_title("/skin/taxels, kPa; places in mm", fontsize=9)
    space.set_box_aspect((np.ptp(x), np.ptp(y), max(np.ptp(z), 0.3 * np.ptp(x))))
    space.view_init(35, -60)
    space.tick_params(labelsize=6)
    figure.colorbar(drawn, ax=space, shrink=0.6)
    return figure


def frame_of(calibration: calib.Calibration, contacts: tuple[tuple[float, float, float], ...]) -> FrameResult:
    """The result of a frame with contacts at x, y (m) of so many N."""
    recon, skin = calibration.recon, calibration.skin
    centres = np.asarray(recon.centres)
    middle = centres[np.asarray(recon.areas) > 0].mean(0)
    bumps = [f * np.exp(-((centres - middle - (x, y)) ** 2).sum(1) / (2 * 0.015**2)) for x, y, f in contacts]
    image, weights = np.sum(bumps, 0), np.asarray(calibration.masks.weights)
    load = weights @ (image * np.asarray(recon.areas))
    force = sum(f for *_, f in contacts) * load / load.sum()
    found = je.fuse(jnp.asarray(image), calibration.masks, jnp.asarray(force))
    unknown = np.full(len(skin.pads), np.nan)
    return FrameResult(
        number=1,
        host=time.monotonic_ns(),
        latency=0.0,
        force=force,
        standard_error=unknown,
        half_width=unknown,
        valid=np.ones(len(skin.pads), bool),
        centre=np.full((len(skin.pads), 2), np.nan),
        map=np.asarray(found.force),
        image=image,
        missing=0,
        dropped=0,
    )


def received(calibration: calib.Calibration, result: FrameResult) -> dict[str, Any]:
    """Decoded messages of a result by topic, as a client of the protocol of Foxglove receives them."""
    client, dynamic = import_module("websockets.sync.client"), import_module("mcap_ros2._dynamic")
    server = FoxgloveServer(port=0)
    found: dict[str, Any] = {}
    with (
        Bridge(calibration, server) as bridge,
        client.connect(server.address, subprotocols=["foxglove.sdk.v1"], close_timeout=0.2) as connection,
    ):
        channels: dict[int, Any] = {}
        while not {"/skin/force_map", "/skin/taxels"} <= set(found):
            bridge.show_result(result)
            data = connection.recv(timeout=5)
            if isinstance(data, bytes):
                _, number, _ = struct.unpack_from("<BIQ", data)
                kind, text = (channels[number][name] for name in ("schemaName", "schema"))
                found[channels[number]["topic"]] = dynamic.generate_dynamic(kind, text)[kind](data[13:])
                continue
            fresh = {channel["id"]: channel for channel in json.loads(data).get("channels", [])}
            channels |= fresh
            wanted = [{"id": number, "channelId": number} for number in fresh]
            connection.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
    return found


# --- LeRobot ---------------------------------------------------------------------------------------------------------


def lerobot_picture(calibration: calib.Calibration, folder: Path) -> Any:
    """Images of a dataset about a press, and the forces of the pads in the same frames."""
    parquet = import_module("pyarrow.parquet")
    with calib.open_session(ROOT / "data" / "sessions" / "testbed_presses.h5") as session:
        calib.apply(calibration, session, folder / "map.h5")
    calib.export_lerobot([folder / "map.h5"], folder / "set", task="press the skin", fps=10)
    info = json.loads((folder / "set/meta/info.json").read_text())
    table = parquet.read_table(folder / "set/data/chunk-000/file-000.parquet").to_pydict()
    state, times = np.array(table["observation.state"]), np.array(table["timestamp"])
    begin = int(np.argmax(state.max(1) > 1.0)) - 2
    chosen = begin + 3 * np.arange(5)
    figure, (whole,) = panels(7.4, 3.4, 1, 1)
    whole.remove()
    grid = figure.add_gridspec(2, 5)
    for column, row in enumerate(chosen):
        ax = figure.add_subplot(grid[0, column])
        png = table["observation.images.skin"][row]["bytes"]
        ax.imshow(matplotlib.image.imread(io.BytesIO(png)))
        ax.set_title(f"{times[row]:.1f} s", fontsize=8)
        ax.set_axis_off()
    below = figure.add_subplot(grid[1, :])
    for name, values in zip(info["features"]["observation.state"]["names"], state.T, strict=True):
        below.plot(times, values, label=name, linewidth=1)
    for row in chosen:
        below.axvline(times[row], color="#bbbbbb", linewidth=0.7)
    below.set_xlim(times[chosen[0]] - 1, times[chosen[-1]] + 4)
    below.set_xlabel("timestamp, s", fontsize=8)
    below.set_ylabel("observation.state, N", fontsize=8)
    below.tick_params(labelsize=7)
    below.legend(fontsize=7, ncols=2)
    return figure


# --- firmware --------------------------------------------------------------------------------------------------------


def firmware_picture(calibration: calib.Calibration, folder: Path) -> Any:
    """A force map in C and in Python, and their difference."""
    frame, pressure, force_map = firmware_frame(calibration)
    calib.export_c(calibration, folder / "skin.h")
    text = (ROOT / "docs" / "firmware.md").read_text(encoding="utf-8")
    (source,) = re.findall(r'```c title="main.c"\n(.*?)```', text, re.DOTALL)
    dump = "fwrite(result.map, sizeof result.map, 1, stdout);"
    source = re.sub(r"for \(int i = 0; i < SKIN_PADS; i\+\+\)\n.*?;\n", dump + "\n", source, flags=re.DOTALL)
    (folder / "main.c").write_text(source, encoding="ascii")
    subprocess.run(["cc", "-std=c99", "-O2", "main.c", "-o", "main", "-lm"], cwd=folder, check=True)
    rest = np.zeros(len(frame) + len(pressure), "f4")
    sent = np.vstack([np.tile(rest, (50, 1)), np.concatenate([frame, pressure])]).astype("f4")
    out = subprocess.run([folder / "main"], input=sent.tobytes(), capture_output=True, check=True).stdout
    rows, columns = calibration.recon.shape
    c, python = (np.asarray(part).reshape(rows, columns)[::-1] for part in (np.frombuffer(out, "f4"), force_map))
    figure, axes = panels(7.4, 2.4, 1, 3)
    shown = (("C, mN on a pixel", 1e3 * c), ("Python", 1e3 * python), ("difference, µN", 1e6 * (c - python)))
    for ax, (title, values) in zip(axes, shown, strict=True):
        figure.colorbar(ax.imshow(values, cmap=COLOURS), ax=ax, shrink=0.8).ax.tick_params(labelsize=7)
        ax.set_title(title, fontsize=9)
        ax.set_axis_off()
    return figure


def firmware_frame(calibration: calib.Calibration) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The strongest press that the calibration keeps: readings (V), pressures (Pa), and the force map (N) by Python."""
    probes = calibration.probes
    assert probes is not None
    assert isinstance(calibration.locator, CentroidLocator)
    row = int(np.argmax(probes.force))
    frame, pressure = probes.dv[row].astype("f4"), probes.pressure[row].astype("f4")
    found = calib.force_map(replace(calibration), frame[None].astype(float), pressure[None].astype(float))
    return frame, pressure, np.asarray(found.map.force)[0]


if __name__ == "__main__":
    main()

"""Files of tanks, written here as other programs write them; the programs of docs/tanks.md on them."""

import itertools
import re
from functools import partial

import h5py
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp
from scipy.io import loadmat, savemat

import calib
import jaxeit as je
from calib.cli import main
from calib.tanks import TankError, difference_image, load_tank

from ..helpers import REAL_DATA
from ..test_docs import blocks, run
from .rods import COUNT, CURRENT, PLACE, RADIUS, sees_the_rod
from .tank_files import forward_model, struct, write_csv, write_ktc, write_mat, write_sciospec

pytest.importorskip("matplotlib")
CSV = "tank_55uA_1000Hz.csv"


def _put(group, name, value, number):
    """A value as MATLAB writes it in format 7.3; ``number`` makes the names of what references lead to."""
    if isinstance(value, dict):
        part = group.create_group(name)
        for key, one in value.items():
            _put(part, key, one, number)
        kind = "struct"
    elif isinstance(value, np.ndarray) and value.dtype.names:
        part, hidden, kind = group.create_group(name), group.file.require_group("#refs#"), "struct"
        for key in value.dtype.names:
            places = [f"r{next(number)}" for _ in value.flat]
            for place, one in zip(places, value[key].flat, strict=True):
                _put(hidden, place, one, number)
            refs = np.array([[hidden[place].ref] for place in places], h5py.ref_dtype)
            part.create_dataset(key, data=refs, dtype=h5py.ref_dtype)
    elif sp.issparse(value):
        part, kind, value = group.create_group(name), "double", sp.csc_array(value)
        part.attrs["MATLAB_sparse"] = np.uint64(value.shape[0])
        for key, numbers in (("data", value.data), ("ir", value.indices), ("jc", value.indptr)):
            part.create_dataset(key, data=numbers.astype(float if key == "data" else np.uint64))
    elif isinstance(value, str):
        part, kind = group.create_dataset(name, data=np.array([[ord(c)] for c in value], np.uint16)), "char"
    else:
        part, kind = group.create_dataset(name, data=np.atleast_2d(np.asarray(value, float)).T), "double"
    part.attrs["MATLAB_class"] = np.bytes_(kind)


def _write_v73(path, variables):
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in variables.items():
            _put(file, name, value, itertools.count(len(file.get("#refs#", ()))))
    path.write_bytes(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM" + path.read_bytes()[128:])
    return path


def test_a_model_of_eidors_is_the_same_model(bench, tmp_path):
    tank = load_tank(write_mat(tmp_path / "tank.mat", bench))
    assert tank.names == ("vh", "vi")
    np.testing.assert_array_equal(tank.frames, bench.frames)
    np.testing.assert_array_equal(tank.skin.protocol.pattern, bench.skin.protocol.pattern)
    np.testing.assert_allclose(je.forward(tank.model()), bench.frames[0], rtol=1e-9)
    found = sees_the_rod(tank)
    assert found.background == pytest.approx(1.0)
    sparse = forward_model(bench)["stimulation"].copy()
    for stimulation in sparse.flat:
        stimulation["stim_pattern"] = sp.csc_array(stimulation["stim_pattern"])
        stimulation["meas_pattern"] = sp.csc_array(stimulation["meas_pattern"])
    variables = {"fmdl": forward_model(bench, {"stimulation": sparse}), "vh": {"meas": bench.frames[0][:, None]}}
    later = load_tank(_write_v73(tmp_path / "later.mat", variables))
    np.testing.assert_array_equal(later.frames, bench.frames[:1])
    np.testing.assert_array_equal(later.mesh.triangles, tank.mesh.triangles)
    assert later.skin.electrodes == tank.skin.electrodes
    np.testing.assert_array_equal(later.skin.protocol.pattern, tank.skin.protocol.pattern)
    points = struct("electrode", [{"nodes": 2.0 + k, "z_contact": 0.0} for k in range(COUNT)])
    as_points = load_tank(write_mat(tmp_path / "points.mat", bench, **points))
    assert all(isinstance(electrode, je.PointElectrode) for electrode in as_points.skin.electrodes)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"elems": np.ones((9, 4))}, "elements have 4 nodes; a sheet is a plane mesh of triangles"),
        ({"elems": np.full((9, 3), np.nan)}, "no arrays of finite numbers"),
        ({"nodes": np.full((9, 2), np.inf)}, "no arrays of finite numbers"),
        ({"elems": np.full((9, 3), 1e4)}, "its triangles name nodes outside 0 to"),
        ({"electrode": []}, "electrode: missing"),
        ({"electrode": struct("e", [{"nodes": [2.0, 9.0]}])["e"]}, r"electrode\(1\): its nodes are no single stretch"),
        ({"stimulation": struct("s", [{"stim_pattern": "{ad}"}])["s"]}, r"stimulation\(1\).stim_pattern: is '{ad}'"),
    ],
)
def test_what_is_no_tank_of_eidors_is_refused(bench, tmp_path, change, message):
    with pytest.raises(TankError, match=message):
        load_tank(write_mat(tmp_path / "tank.mat", bench, **change))


def test_files_that_do_not_describe_their_tank(bench, tmp_path):
    csv = load_tank(write_csv(tmp_path / CSV, bench.frames), je.Disc(RADIUS))
    assert (csv.skin.protocol.current, csv.skin.protocol.frequency) == (pytest.approx(CURRENT), 1000)
    np.testing.assert_allclose(csv.frames, bench.frames)
    np.testing.assert_allclose(csv.quadrature, -0.1 * bench.frames)
    found = sees_the_rod(csv)
    half = difference_image(csv, 0, 1, basis=je.Pixels(24))
    assert float(half.change.min()) < 0 < float(found.change.max())

    np.savez(tmp_path / "rows.npz", frames=bench.frames, pattern=bench.skin.protocol.pattern, amplitude=CURRENT)
    np.testing.assert_array_equal(load_tank(tmp_path / "rows.npz", je.Disc(RADIUS)).frames, bench.frames)
    np.savez(tmp_path / "name.npz", frames=bench.frames, pattern="adjacent", amplitude=CURRENT)
    with pytest.raises(TankError, match=r"name\.npz: pattern and amplitude: the pattern has shape \(\); give one row"):
        load_tank(tmp_path / "name.npz", je.Disc(RADIUS))
    with pytest.raises(TankError, match="does not tell the shape of the tank"):
        load_tank(tmp_path / "rows.npz")
    reversed_polarity = calib.tanks.Tank(csv.skin, -csv.frames, csv.names)
    with pytest.raises(
        TankError, match=r"correlation of frame 0 .* is -.*check the order and the polarity.*the other sign"
    ):
        difference_image(reversed_polarity)
    with pytest.raises(TankError, match="all readings of frame 0 are the same number; give a recorded frame"):
        difference_image(calib.tanks.Tank(csv.skin, 0 * csv.frames, csv.names))
    with pytest.raises(TankError, match="transpose them, so that each row is a frame"):
        calib.tanks.Tank(csv.skin, csv.frames.T, csv.names)
    with pytest.raises(TankError, match="2 frames have 1 names; give one to each"):
        calib.tanks.Tank(csv.skin, csv.frames, csv.names[:1])
    np.savez(tmp_path / "alone.npz", frames=bench.frames)
    with pytest.raises(TankError, match=r"holds \['frames'\]; save frames with .*, as --skin TANK.toml"):
        load_tank(tmp_path / "alone.npz", je.Disc(RADIUS))
    with pytest.raises(TankError, match="str is not a skin; make one, such as"):
        load_tank(tmp_path / "alone.npz", skin="tank.toml")
    for frame in (0, -2, 7):
        with pytest.raises(TankError, match=f"frame {frame} less frame 0, of 2 frames; give two different ones"):
            difference_image(csv, frame)
    with pytest.raises(TankError, match=r"no\.csv: does not exist"):
        load_tank(tmp_path / "no.csv", je.Disc(RADIUS))


def test_a_tank_whose_scan_is_named(bench, tmp_path, root, capsys):
    """The file of the page, with frames of all electrodes driven at once; another rod than the reference's place."""
    text = next(text for _, title, text in blocks(root / "docs" / "tanks.md") if title == "tank.toml")
    (tmp_path / "tank.toml").write_text(text.replace("0.14", str(RADIUS)).replace("width = 0.02", "width = 0.005"))
    skin = je.load_skin(tmp_path / "tank.toml")
    model = je.discretise(je.Scene(skin), je.Fidelity(edge_length=0.06))
    rod = jnp.linalg.norm(model.centroids - PLACE, axis=1) < 0.004
    frames = np.array([je.forward(model, jnp.where(rod, gain, 1.0) * model.background) for gain in (1.0, 5.0)])
    path = tmp_path / "frames.npz"
    np.savez(path, frames=frames)
    tank = load_tank(path, skin=skin)
    assert tank.frames.shape == (2, 240)
    sees_the_rod(tank)
    words = ["image", str(path), "--skin", str(tmp_path / "tank.toml"), "-o", str(tmp_path / "picture.png")]
    assert main(words) == 0
    assert "16 electrodes, 240 readings" in capsys.readouterr().out
    assert main([*words, "--radius", "1"]) == 2
    assert "leave out --radius" in capsys.readouterr().err
    np.savez(path, frames=frames, pattern=bench.skin.protocol.pattern, amplitude=CURRENT)
    with pytest.raises(TankError, match="other files have a scan of their own: leave the skin out"):
        load_tank(path, skin=skin)


def test_readings_alone_are_read_as_numpy_and_tables_hold_them(bench, tmp_path, capsys):
    """Arrays by their names, the reference first; a table with a frame in each row, or in each named column."""
    text = TANK_TOML.replace("eidors-adjacent", "adjacent")
    (tmp_path / "tank.toml").write_text(text)
    skin, (vh, vi) = je.load_skin(tmp_path / "tank.toml"), bench.frames[:2]
    np.savez(tmp_path / "named.npz", vi=vi, vh=vh, angle=np.ones(3))
    np.save(tmp_path / "plain.npy", bench.frames)
    np.savetxt(tmp_path / "rows.csv", bench.frames, "%.17g", ",")
    np.savetxt(tmp_path / "columns.csv", np.stack([vi, vh], 1), "%.17g", ";", header="vi;vh", comments="")
    named = {"named.npz": ("vh", "vi"), "columns.csv": ("vh", "vi"), "plain.npy": None, "rows.csv": None}
    for name, names in named.items():
        tank = load_tank(tmp_path / name, skin=skin)
        assert tank.names == (names or tuple(f"frame {k}" for k in range(len(bench.frames))))
        np.testing.assert_array_equal(tank.frames[:2], [vh, vi])
    words = [
        "image",
        str(tmp_path / "columns.csv"),
        "--skin",
        str(tmp_path / "tank.toml"),
        "-o",
        str(tmp_path / "a.png"),
    ]
    assert main([*words, "--hyperparameter", "l-curve"]) == 0
    assert re.search(r"\nhyperparameter [\d.e-]+\n", capsys.readouterr().out)
    assert main([*words, "--hyperparameter", "lcurve"]) == 2
    assert "--hyperparameter: no hyperparameter 'lcurve'; did you mean 'l-curve'?" in capsys.readouterr().err


class Faint(je.Tikhonov):
    """A prior that a user wrote."""


def test_image_takes_the_choices_of_images_and_priors_of_ones_own(bench, tmp_path, capsys):
    (tmp_path / "tank.toml").write_text(TANK_TOML.replace("eidors-adjacent", "adjacent"))
    np.save(tmp_path / "frames.npy", bench.frames)
    files = [str(tmp_path / "frames.npy"), "--skin", str(tmp_path / "tank.toml"), "-o", str(tmp_path / "a.png")]
    for choices in (
        ["--prior", f"{__name__}:Faint", "--pixels", "12"],
        ["--basis", "bumps:columns=9", "--method", "greit"],
    ):
        assert main(["image", *files, *choices]) == 0
    capsys.readouterr()
    assert main(["image", *files, "--prior", "laplac"]) == 2
    assert "--prior: no prior 'laplac'; did you mean 'laplace'?" in capsys.readouterr().err
    assert main(["image", *files, "--basis", "elements"]) == 2
    assert "--basis elements: elements make no picture" in capsys.readouterr().err
    assert main(["image", *files, "--classes", "--prior", "laplace"]) == 2
    assert "--prior: for images of a change, and --classes chooses its own" in capsys.readouterr().err


def test_tables_of_spreadsheets_are_read(bench, tmp_path):
    """Semicolons and decimal commas, quotes, a delimiter at the end, names behind "#" (UTF-16), an empty cell."""
    skin, (vh, vi) = je.skin.parse_skin(TANK_TOML.replace("eidors-adjacent", "adjacent")), bench.frames[:2]
    points = [(f"{b:.17g}", f"{a:.17g}") for a, b in zip(vh, vi, strict=True)]
    commas = [tuple(cell.replace(".", ",") for cell in row) for row in points]
    tables = {
        "german.csv": ["vi;vh", *map(";".join, commas)],
        "quoted.csv": ['"vi","vh"', *(f'"{a}","{b}"' for a, b in commas)],
        "ended.csv": ["vi;vh;", *(f"{a};{b};" for a, b in commas)],
        "savetxt.csv": ["# vi vh", *map(" ".join, points)],
    }
    for name, lines in tables.items():
        (tmp_path / name).write_text("\n".join(lines) + "\n", encoding="utf-16" if name == "savetxt.csv" else "utf-8")
        tank = load_tank(tmp_path / name, skin=skin)
        assert tank.names == ("vh", "vi"), name
        np.testing.assert_array_equal(tank.frames, [vh, vi], name)
    (tmp_path / "gap.csv").write_text("\n".join(["vi;vh", *map(";".join, commas[:-1]), f"{commas[-1][0]};"]))
    assert np.isnan(load_tank(tmp_path / "gap.csv", skin=skin).frames).sum() == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1,2\n3,4\n", "a.csv: holds a table 2 x 2; the protocol of the skin has 208 readings"),
        ("1,2\n3\n", r"a.csv: rows have \[1, 2\] numbers; give a table"),
        ("vh\n1,2\n", "a.csv: line 1: the header has 1 names, the rows have 2 cells; correct the header"),
        ("vh,vi\n1,two\n", "a.csv: line 2: 'two' is no number; correct it, or leave the cell empty"),
        ("vh;vi\n1,5;2.5\n1,5;2,5\n1,5;2,5\n", "a.csv: line 2: '2.5' is no number"),
        ("", "a.csv: file: holds no rows; give a table of numbers"),
    ],
)
def test_tables_that_do_not_fit_their_skin(text, message, tmp_path):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(TankError, match=message):
        load_tank(tmp_path / "a.csv", skin=je.skin.parse_skin(TANK_TOML))


TANK_TOML = f"""
format = "jaxeit-skin"
version = 1
name = "tank"
[sheet]
shape = "disc"
radius = {RADIUS}
sheet_resistance = 1.0
[electrodes]
kind = "edge"
count = 16
width = 0.005
contact = 2e-3
[protocol]
pattern = "eidors-adjacent"
current = {CURRENT}
"""


def _as_eidors(frames):
    """Of every drive all pairs from the first on, zero where a driven electrode takes part; above zero."""
    square = np.zeros((len(frames), COUNT, COUNT))
    for drive, step in itertools.product(range(COUNT), range(2, COUNT - 1)):
        square[:, drive, (drive + step) % COUNT] = -frames[:, (COUNT - 3) * drive + step - 2]
    return square.reshape(len(frames), -1).T


def test_matlab_files_without_a_model(bench, tmp_path, capsys):
    """The readings of 'no_meas_current' and of 'meas_current', and a stimulation that tells another order."""
    (tmp_path / "tank.toml").write_text(TANK_TOML)
    skin = je.load_skin(tmp_path / "tank.toml")
    every = _as_eidors(bench.frames)
    kept = every[every[:, 0] != 0]
    savemat(tmp_path / "kept.mat", {"vi": {"meas": kept[:, 1]}, "vh": {"meas": kept[:, 0]}, "volts": np.ones(16)})
    tank = load_tank(tmp_path / "kept.mat", skin=skin)
    assert tank.names == ("vh", "vi")
    np.testing.assert_array_equal(tank.frames, kept.T)
    sees_the_rod(tank)
    savemat(tmp_path / "every.mat", {"data": 2 * every, "vvRef": every[:, :1]})
    for pattern in ("adjacent", "eidors-adjacent"):
        rows = je.skin.named_pattern(pattern, COUNT)
        ours = je.Skin("ours", skin.domain, 1.0, skin.electrodes, je.Protocol(rows, CURRENT))
        tank = load_tank(tmp_path / "every.mat", skin=ours)
        assert tank.names == ("vvRef", "data(1)", "data(2)")
        expected = bench.frames[0] if pattern == "adjacent" else kept[:, 0]
        np.testing.assert_array_equal(tank.frames[:2], [expected, 2 * expected])
    told = {"vh": bench.frames[0], "vi": bench.frames[1], "stim": forward_model(bench)["stimulation"]}
    savemat(tmp_path / "told.mat", told)
    tank = load_tank(tmp_path / "told.mat", skin=skin)
    np.testing.assert_array_equal(tank.skin.protocol.pattern, bench.skin.protocol.pattern)
    sees_the_rod(tank)
    words = ["image", str(tmp_path / "kept.mat"), "--skin", str(tmp_path / "tank.toml"), "-o", str(tmp_path / "a.png")]
    assert main(words) == 0
    assert "16 electrodes, 208 readings, frames: vh, vi" in capsys.readouterr().out


def test_matlab_files_that_do_not_fit_their_skin(bench, tmp_path, capsys):
    (tmp_path / "tank.toml").write_text(TANK_TOML)
    skin = je.load_skin(tmp_path / "tank.toml")
    path = tmp_path / "a.mat"
    savemat(path, {"vh": np.ones(200), "vi": np.ones((200, 3)), "note": "none"})
    message = (
        "a.mat: holds vh 200 x 1, vi 200 x 3; the protocol of the skin has 208 readings of 16 electrodes: give the "
        "protocol of these readings, or save them as columns of as many rows"
    )
    with pytest.raises(TankError) as found:
        load_tank(path, skin=skin)
    assert str(found.value) == message
    assert main(["image", str(path), "--skin", str(tmp_path / "tank.toml"), "-o", str(tmp_path / "a.png")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    with pytest.raises(TankError, match=r"no variable has a forward model .* --skin TANK\.toml"):
        load_tank(path)
    savemat(path, {"text": "none"})
    with pytest.raises(TankError, match="holds no numbers; the protocol of the skin has 208"):
        load_tank(path, skin=skin)
    savemat(path, {"vh": np.ones(9), "stim": forward_model(bench)["stimulation"]})
    with pytest.raises(TankError, match="holds vh 9 x 1; the protocol of stim has 208 readings"):
        load_tank(path, skin=skin)
    with pytest.raises(TankError, match=r"tank\.mat: has a tank of its own; leave the skin out"):
        load_tank(write_mat(tmp_path / "tank.mat", bench), skin=skin)


def test_potentials_of_sciospec(bench, tmp_path):
    """Of two frequencies the first is taken."""
    write_sciospec(tmp_path, bench)
    tank = load_tank(tmp_path, bench.skin.domain, bench.skin.electrodes)
    assert tank.names == ("setup_00001", "setup_00002")
    assert (tank.skin.protocol.readings, tank.skin.protocol.frequency) == (208, 1000)
    rows = {tuple(row): value for row, value in zip(bench.skin.protocol.pattern.tolist(), bench.frames[0], strict=True)}
    expected = [rows[tuple(row)] for row in tank.skin.protocol.pattern.tolist()]
    np.testing.assert_allclose(tank.frames[0], expected, rtol=1e-5)
    (tmp_path / "setup_00003.eit").write_bytes(b"\x00\x01binary")
    with pytest.raises(TankError, match=r"setup_00003\.eit: does not begin like"):
        load_tank(tmp_path, bench.skin.domain)


def test_frames_of_the_kuopio_challenge(tmp_path):
    readings = write_ktc(tmp_path)
    found = load_tank(tmp_path / "data1.mat")
    assert found.names == ("ref", "data1")
    np.testing.assert_allclose(je.forward(found.model()), readings, rtol=1e-12)
    assert load_tank(tmp_path / "ref.mat").names == ("ref",)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.csv", "1,2\n" * 17, "has 17 lines, which is no n"),
        ("a.csv", "1,2\n1,2\n1,x\n1,2\n", "line 3: 'x' is no number"),
        ("a.csv", "1\n" * 4, "lines have 1 columns"),
        ("a.mat", "no MATLAB", "is no MATLAB file"),
        ("b.mat", "# Created by Octave 7.3.0\n# name: vh\n", r"Octave.*save\('-v7"),
        ("a.npz", "no archive", "cannot be read as a NumPy archive"),
        ("a.xyz", "", "is no file of a tank; give .mat"),
    ],
)
def test_other_files_are_refused(tmp_path, name, content, message):
    (tmp_path / name).write_text(content)
    with pytest.raises(TankError, match=message):
        load_tank(tmp_path / name, je.Disc(RADIUS))


def test_a_folder_without_frames_is_named(tmp_path):
    with pytest.raises(TankError, match=f"{tmp_path}: is a folder without .eit files; give a file, or a folder of"):
        load_tank(tmp_path, je.Disc(RADIUS))


@pytest.mark.slow
def test_the_page_goes_from_a_file_to_a_picture(bench, tmp_path, root, monkeypatch, capsys):
    """At most ten lines; the same from the command line."""
    page = root / "docs" / "tanks.md"
    first = next(text for language, _, text in blocks(page) if language == "python")
    assert len([line for line in first.splitlines() if line]) <= 10
    monkeypatch.chdir(tmp_path)
    write_csv(tmp_path / CSV, bench.frames)
    write_mat(tmp_path / "tank.mat", bench)
    names = run(page, {})
    assert (tmp_path / "picture.png").read_bytes().startswith(b"\x89PNG")
    assert "('vh', 'vi'), 1.0000" in capsys.readouterr().out
    assert np.abs(np.asarray(names["voltages"])[:, [0]]).max() > 0
    assert main(["image", CSV, "--radius", str(RADIUS), "--start", "90", "-o", "turned.svg"]) == 0
    assert "correlation with an even tank" in capsys.readouterr().out
    assert "<svg" in (tmp_path / "turned.svg").read_text()
    assert main(["image", "tank.mat", "--fit-contacts", "one", "-o", "fitted.png"]) == 0
    fitted = re.search(r"fitted to the reference: (\S+) S \+- (\S+) %", capsys.readouterr().out)
    level, percent = map(float, fitted.groups())
    assert abs(level - 1) < 2 * percent / 100 < 0.01
    assert main(["image", "tank.mat", "--classes", "-o", "classes.png"]) == 0
    assert " 0 cm^2 resistive (blue), " in capsys.readouterr().out
    assert main(["image", CSV, "-o", "no.png"]) == 2
    assert "--radius" in capsys.readouterr().err
    assert main(["image", CSV, "--radius", "30", "-o", "no.png"]) == 2
    assert "60 m across" in (told := capsys.readouterr().err)
    assert "--radius 0.03 for 30 mm" in told
    assert main(["image", CSV, "--radius", str(RADIUS), "-o", "no.gif"]) == 2
    assert not (tmp_path / "no.gif").exists()


TANK = REAL_DATA / "pyeidors_tank" / "tank"
KTC = REAL_DATA / "ktc2023" / "training" / "data1.mat"


@pytest.mark.skipif(not TANK.is_dir(), reason="pyeidors_tank is not at hand; set JAXEIT_REAL_DATA to its folder")
def test_the_page_on_a_real_tank(root, tmp_path, monkeypatch):
    """Plastic at electrode 5 and 9, metal at 1 and 13, counted from 1."""
    (path,) = TANK.glob("*/*plastic_electrode13_metal/*-21-27-54*.csv")
    program = next(text for language, _, text in blocks(root / "docs" / "tanks.md") if language == "python")
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(program.replace(CSV, str(path)), names)
    found, skin = names["found"], names["tank"].skin
    assert found.correlation > 0.99
    for number, sign in ((1, 1), (5, -1), (9, -1), (13, 1)):
        place = 0.65 * skin.electrode_positions[number - 1]
        near = np.linalg.norm(np.asarray(found.recon.centres) - place, axis=1) < 0.005
        assert sign * float(jnp.mean(found.change[near])) > 0.2, number


@pytest.mark.slow
@pytest.mark.skipif(not KTC.exists(), reason="ktc2023 is not at hand; set JAXEIT_REAL_DATA to its folder")
def test_matrices_of_the_kuopio_challenge_explain_its_water():
    tank = load_tank(KTC)
    water = tank.frames[0]
    assert tank.skin.protocol.readings == len(water) == 2356
    assert np.corrcoef(np.asarray(je.forward(tank.model())), water)[0, 1] > 0.99


def test_one_frame_shows_the_conductivity(bench, tmp_path, capsys, monkeypatch):
    """A rod that conducts five times better, and a frame of readings that err by a thousandth."""
    frames = bench.frames * (1 + 1e-3 * np.random.default_rng(4).normal(size=bench.frames.shape))
    np.savez(tmp_path / "one.npz", frames=frames[1:], pattern=bench.skin.protocol.pattern, amplitude=CURRENT)
    tank = load_tank(tmp_path / "one.npz", bench.skin.domain, bench.skin.electrodes)
    found = calib.tanks.conductivity_image(tank, basis=je.Pixels(20), error=2e-3)
    shown, model = found.shown, found.model
    np.testing.assert_allclose(np.asarray(shown.picture.centres)[np.argmax(shown.image)], PLACE, atol=0.004)
    rod = np.linalg.norm(model.centroids - PLACE, axis=1) < 0.003
    assert 1.8 < np.mean(shown.sigma[rod]) < 7
    assert abs(np.median(shown.sigma) - 1) < 0.05
    assert shown.misfit < 1.2
    shape = (40, 40)
    by_pixel = je.imaging.on_grid(shown.image, shown.picture, shape)
    by_element = je.imaging.on_grid(shown.sigma, model, shape)
    assert np.corrcoef(by_pixel.ravel(), by_element.ravel())[0, 1] > 0.95
    args = [str(tmp_path / "one.npz"), "--radius", str(RADIUS), "-o", str(tmp_path / "p.png")]
    assert main(["image", *args, "--absolute"]) == 0
    said = capsys.readouterr().out
    assert re.search(r"p\.png: conductivity [\d.]+ to [\d.]+ S", said)
    assert "converged" not in said
    short = partial(je.imaging.gauss_newton_fit, steps=1)
    with monkeypatch.context() as patched:
        patched.setattr("jaxeit.imaging.absolute.one_frame.gauss_newton_fit", short)
        assert main(["image", *args, "--absolute"]) == 0
    assert "the fit of the image has not converged" in capsys.readouterr().out
    assert (tmp_path / "p.png").stat().st_size > 5000
    assert main(["image", *args, "--absolute", "--classes"]) == 2
    assert main(["image", *args, "--absolute", "--normalised"]) == 2
    with pytest.raises(TankError, match="has 1 frames; there is no frame 2"):
        calib.tanks.conductivity_image(tank, 2)


@pytest.mark.slow
def test_an_offset_that_is_fitted_is_taken_from_the_frames(bench, tmp_path, capsys):
    offset = 0.35 * np.sqrt(np.mean(bench.frames**2))
    path, args = tmp_path / "offset.npz", ["--radius", str(RADIUS), "-o", str(tmp_path / "offset.png")]
    np.savez(path, frames=bench.frames - offset, pattern=bench.skin.protocol.pattern, amplitude=CURRENT)
    assert main(["image", str(path), *args, "--fit-offset", "1"]) == 2
    assert "add --fit-contacts one or each" in capsys.readouterr().err
    assert main(["image", str(path), *args, "--fit-contacts", "one"]) == 2
    size = re.search(r"--fit-offset (\S+)\n", capsys.readouterr().err)[1]
    assert float(size) == pytest.approx(offset, rel=0.1)
    assert main(["image", str(path), *args, "--fit-contacts", "one", "--fit-offset", size]) == 0
    level = re.search(r"fitted to the reference: (\S+) S", capsys.readouterr().out)[1]
    assert abs(float(level) - 1) < 0.02
    tank = load_tank(path, bench.skin.domain, bench.skin.electrodes)
    choices = {"basis": je.Pixels(12), "fidelity": je.Fidelity.draft(order=2)}
    settings = je.imaging.ReferenceSettings(contact=0, contact_each=0, offset=2 * offset)
    found = difference_image(tank, fit=settings, **choices)
    wanted = difference_image(calib.tanks.Tank(tank.skin, bench.frames, tank.names), **choices)
    assert found.background == pytest.approx(1, abs=0.02)
    np.testing.assert_allclose(found.change, wanted.change, atol=0.03 * float(jnp.max(wanted.change)))
    seen = np.asarray(found.fit.corrected(tank.frames))
    np.testing.assert_allclose(seen, bench.frames, atol=0.02 * np.abs(bench.frames).max())


def test_a_normalised_difference_weighs_readings_by_their_size(bench, tmp_path):
    """As inv_solve of EIDORS with normalize_measurements: ``dv / v0``, with each row of the Jacobian over v0 too."""
    tank = load_tank(write_csv(tmp_path / CSV, bench.frames), bench.skin.domain)
    found = difference_image(tank, basis=je.Pixels(12), hyperparameter=0.2, normalised=True)
    model = tank.model()
    even = np.asarray(je.forward(model))
    scale = even @ even / (even @ tank.frames[0])
    before, after = scale * tank.frames
    jac = np.asarray(je.jacobian(model, basis=je.Pixels(12))) / before[:, None]
    found_by_hand = _noser_image(jac, (after - before) / before, 0.2) / float(model.background[0])
    np.testing.assert_allclose(found.change, found_by_hand, rtol=1e-3, atol=1e-3 * np.abs(found_by_hand).max())


def test_noise_of_the_reference_does_not_lower_the_conductivity(bench):
    """By the readings' own least squares; the readings over the model's would lose the share of the noise, 4 %."""
    noise = np.random.default_rng(0).normal(0, 1, bench.frames.shape[1])
    even = bench.frames[0]
    noise -= even * (noise @ even) / (even @ even)
    before = even + 0.2 * np.linalg.norm(even) / np.linalg.norm(noise) * noise
    choices = {"basis": je.Pixels(8), "fidelity": je.Fidelity(edge_length=0.06)}
    tank = calib.tanks.Tank(bench.skin, np.stack([before, bench.frames[1]]), ("noisy", "rod"))
    assert difference_image(tank, **choices).background == pytest.approx(1, rel=1e-3)


def test_an_offset_that_turns_the_sign_of_the_readings_is_refused(bench):
    frames = bench.frames + 3 * np.sqrt(np.mean(bench.frames**2))  # readings of an even tank are below zero
    tank = calib.tanks.Tank(bench.skin, frames, ("even", "rod"))
    with pytest.raises(TankError, match="have an offset that turns their sign"):
        difference_image(tank, basis=je.Pixels(8), fidelity=je.Fidelity.draft())


def _noser_image(jac, dv, h):
    size = np.linalg.norm(jac, axis=0)
    r = np.maximum(size, 1e-3 * size.max())
    strength = h**2 * np.trace(jac / r @ jac.T) / len(jac)
    return np.linalg.solve(jac.T @ jac + strength * np.diag(r), jac.T @ dv)


@pytest.mark.slow
def test_good_contacts_are_fitted_as_hardly_known(tmp_path, capsys):
    """Linear elements miss a resistance, so that quadratic ones would need one below zero; damped steps did not end."""
    write_ktc(tmp_path)
    assert main(["image", str(tmp_path / "data1.mat"), "--fit-contacts", "one", "-o", str(tmp_path / "p.png")]) == 0
    error = re.search(r"\+- ([\d.e+]+) to [\d.e+]+ %$", capsys.readouterr().out, re.MULTILINE)
    assert float(error[1]) > 100


def test_a_fit_of_the_reference_that_does_not_converge_is_refused(tmp_path, capsys, monkeypatch):
    write_ktc(tmp_path)
    lost = lambda problem, known, weight, start: (start, jnp.ones(()), jnp.asarray(False))  # noqa: E731
    monkeypatch.setattr("jaxeit.imaging.absolute.reference._most_probable", lost)
    assert main(["image", str(tmp_path / "data1.mat"), "--fit-contacts", "one", "-o", str(tmp_path / "p.png")]) == 2
    assert "does not converge" in (told := capsys.readouterr().err)
    assert "leave out --fit-contacts" in told
    assert not (tmp_path / "p.png").exists()


def test_what_a_damaged_file_describes_is_refused_by_its_name(bench, tmp_path):
    """Numbers that are well formed and describe no scan, or no sheet."""
    lost = forward_model(bench)
    lost["stimulation"][0, 3]["stim_pattern"][2] += 1e-3
    with pytest.raises(TankError, match=r"tank\.mat: fwd_model\.stimulation: the current of drive 3 sums to"):
        load_tank(write_mat(tmp_path / "tank.mat", bench, **lost))
    write_ktc(tmp_path)
    variables = loadmat(tmp_path / "data1.mat")
    variables["Mpat"][0, 0] = 0.5
    savemat(tmp_path / "data1.mat", {name: variables[name] for name in ("Inj", "Mpat", "Uel")})
    with pytest.raises(TankError, match=r"data1\.mat: the measurement 0 of drive 0 sums to"):
        load_tank(tmp_path / "data1.mat")
    write_sciospec(tmp_path, bench)
    lines = (tmp_path / "setup_00001.eit").read_text().splitlines()
    lines[18] = "1 1"
    (tmp_path / "setup_00001.eit").write_text("\n".join(lines))
    with pytest.raises(TankError, match=r"setup_00001: row 0 of the pattern.* uses one electrode twice"):
        load_tank(tmp_path / "setup_00001.eit", je.Disc(RADIUS))

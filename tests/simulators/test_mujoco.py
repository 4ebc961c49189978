"""Contacts of MuJoCo on a skin: bodies at rest, whose forces are known from statics."""

import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

import calib
import jaxeit as je
from calib.cli import main
from calib.simulators import SimulatorError
from tests.test_docs import run

mujoco = pytest.importorskip("mujoco")

from calib.simulators.mujoco import ContactReader, SensorReader  # noqa: E402  it needs the optional extra

GRAVITY = 9.81
REPORTED = 'data="found force pos normal tangent" reduce="maxforce"'


def at_rest(bodies, seconds=2.0, assets=""):
    """A model and its data after so long a time, in s."""
    model = mujoco.MjModel.from_xml_string(f"<mujoco>{assets}<worldbody>{bodies}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, round(seconds / model.opt.timestep))
    return model, data


def test_a_ball_on_a_board_presses_with_its_weight(skin):
    """The board is thin and lies on the floor, whose forces under it are not on the sheet."""
    model, data = at_rest(
        """<geom type="plane" size="1 1 1"/>
        <body pos="0.3 0.2 0.0025"><freejoint/>
          <geom name="board" type="box" size=".099 .099 .0025" mass="2"/><site name="sheet" pos="-.1 -.1 .0025"/></body>
        <body name="ball" pos="0.27 0.24 0.035"><freejoint/>
          <geom type="sphere" size=".03" mass="1.2" condim="6"/></body>"""
    )
    placed = ContactReader(model, skin, geoms=["board"], site="sheet", slots=2)(data)
    np.testing.assert_allclose(placed.contacts.force, [1.2 * GRAVITY, 0], rtol=1e-3)
    below = data.body("ball").xpos[:2] - data.site("sheet").xpos[:2]  # it rolls a little: the board sinks unevenly
    np.testing.assert_allclose(below, [0.07, 0.14], atol=5e-3)
    np.testing.assert_allclose(placed.contacts.position[0], below, atol=1e-4)
    assert (int(placed.off_sheet), int(placed.pulling)) == (0, 4)


def test_a_block_on_a_slope(skin):
    """Its weight presses with its normal part, at the point under its middle that gravity passes through."""
    slope, height = np.radians(10), 0.03
    x, z = (0.01 + height / 2) * np.array([-np.sin(slope), np.cos(slope)])
    model, data = at_rest(
        f"""<body euler="0 -10 0"><geom name="board" type="box" size=".1 .1 .01"/><site name="sheet" pos="-.1 -.1 .01"/>
          </body>
        <body name="block" euler="0 -10 0" pos="{x} 0.02 {z}">
          <freejoint/><geom type="box" size=".02 .02 {height / 2}" mass="1.5" friction="1.5 .005 .0001"/></body>"""
    )
    contacts = ContactReader(model, skin, geoms=["board"], site="sheet")(data).contacts
    assert np.sum(contacts.force > 0) == 4
    assert contacts.force.sum() == pytest.approx(1.5 * GRAVITY * np.cos(slope), rel=2e-3)
    centre = contacts.force @ contacts.position / contacts.force.sum()
    uphill = (data.body("block").xpos - data.site("sheet").xpos) @ [np.cos(slope), 0, np.sin(slope)]
    assert uphill == pytest.approx(0.1, abs=5e-3)  # friction creeps in MuJoCo
    np.testing.assert_allclose(centre, [uphill - height / 2 * np.tan(slope), 0.12], atol=1e-4)


def test_a_finger_on_the_chest():
    """The chest's axis points along world x; the finger presses along its normal, 0.3 rad from its middle."""
    angle, force, radius = 0.3, 6.0, 0.008
    y, z = np.sin(angle), np.cos(angle)
    assets = """<option gravity="0 0 0"/><actuator><motor joint="down" gear="-1"/></actuator>"""
    model, data = at_rest(
        f"""<body pos="1 2 3"><geom name="chest" type="cylinder" size="0.3 0.14" euler="0 90 0"/>
          <site name="sheet" pos="0.14 0 0" euler="0 0 90"/></body>
        <body pos="1.05 {2 + (0.301 + radius) * y} {3 + (0.301 + radius) * z}">
          <joint name="down" type="slide" axis="0 {y} {z}" damping="5"/>
          <geom type="sphere" size="{radius}" mass="0.1"/></body>""",
        assets=assets,
        seconds=0,
    )
    data.ctrl[0] = force
    mujoco.mj_step(model, data, 1000)
    chest = je.load_skin("chest")
    reader = ContactReader(model, chest, geoms=["chest"], site="sheet", slots=1, diameter=2 * radius)
    batch = reader.batch([data, mujoco.MjData(model)])
    np.testing.assert_allclose(batch.contacts.force[:, 0], [force, 0], rtol=1e-3)
    # Along -y of the sheet from the site lies world x; along its x lies world y, from the middle at 0.14 m.
    np.testing.assert_allclose(batch.contacts.position[0, 0], [0.14 + 0.3 * angle, 0.09], atol=1e-3)
    assert batch.contacts.diameter[0, 0] == 2 * radius


BALLS = """
<geom name="board" type="box" size=".15 .1 .01" euler="0 8 0"/><site name="sheet" pos="-.1 -.1 .01"/>
<body pos="-.03 .02 .04"><freejoint/><geom type="sphere" size=".03" mass="1"/></body>
<body pos="0.05 -.04 .05"><freejoint/><geom type="box" size=".02 .02 .02" mass="0.7"/></body>
<body pos="0.12 .06 .025"><freejoint/><geom type="sphere" size=".03" mass="1"/></body>"""


def sorted_rows(contacts):
    force = np.asarray(contacts.force)[:, None]
    rows = np.where(force > 0, np.concatenate([contacts.position, force], 1), 0)
    return rows[np.lexsort(rows[:, ::-1].T.round(9))]


def test_a_contact_sensor_tells_what_the_list_of_contacts_tells(skin):
    """Under friction, on a board that is not level, with a contact past the rim; of all environments in one call."""
    sensor = f'<sensor><contact name="touch" geom1="board" num="8" {REPORTED}/></sensor>'
    models = [at_rest(BALLS, seconds, sensor) for seconds in (0.0, 0.06, 0.1)]
    model = models[0][0]
    reader = ContactReader(model, skin, geoms=["board"], site="sheet", slots=8, reach=0.02)
    sensed = SensorReader(model, skin, sensor="touch", site="sheet", reach=0.02)
    batch = mujoco_arrays([data for _, data in models])
    many, pressing = sensed(batch), 0
    for row, (_, data) in enumerate(models):
        listed = reader(data)
        one = sensed(data)
        np.testing.assert_allclose(sorted_rows(one.contacts), sorted_rows(listed.contacts), atol=1e-9)
        np.testing.assert_allclose(many.contacts.force[row], one.contacts.force, rtol=1e-12)
        told = [(int(x.off_sheet), int(x.pulling), int(x.unreported)) for x in (one, listed)]
        assert told[0] == told[1], told
        pressing += int(np.sum(listed.contacts.force > 0))
    assert pressing > 3
    assert many.off_sheet.max() > 0


def mujoco_arrays(datas):
    """What a batch of environments has, with a leading axis."""
    fields = ("sensordata", "site_xpos", "site_xmat")
    return SimpleNamespace(**{name: np.stack([getattr(data, name) for data in datas]) for name in fields})


def test_a_sensor_of_another_kind_is_refused(skin):
    sensor = '<sensor><contact name="touch" geom1="board" data="found force"/></sensor>'
    model, _ = at_rest('<geom name="board" type="box" size=".1 .1 .01"/><site name="sheet"/>', 0, sensor)
    with pytest.raises(SimulatorError, match="make it <contact geom1="):
        SensorReader(model, skin, sensor="touch", site="sheet")


@pytest.mark.slow
def test_the_programs_of_the_page(root):
    pytest.importorskip("mujoco.batch")  # MuJoCo 3.17 and later
    names = run(root / "docs" / "mujoco.md", {})
    assert names["weight"] == pytest.approx(1.2 * GRAVITY, rel=0.02)
    on_pads = names["change"][1] @ np.array([pad.area for pad in names["scene"].skin.pads])
    assert on_pads == pytest.approx(1.2 * GRAVITY, rel=0.15)  # the borders of pads are stiff
    assert names["many"].frame.shape == (64, 550)
    np.testing.assert_allclose(names["many"].load, 1.2 * GRAVITY, rtol=0.05)


def test_names_that_the_model_does_not_have(skin):
    model, _ = at_rest('<geom name="board" type="box" size=".1 .1 .01"/><site name="sheet"/>', 0)
    with pytest.raises(SimulatorError, match="no geom 'bord'"):
        ContactReader(model, skin, geoms=["bord"], site="sheet")
    with pytest.raises(SimulatorError, match="geoms is empty"):
        ContactReader(model, skin, geoms=[], site="sheet")
    with pytest.raises(SimulatorError, match="no site 'shet'"):
        ContactReader(model, skin, geoms=["board"], site="shet")


def test_nothing_of_mujoco_is_imported_unless_asked_for():
    code = "import sys, calib, calib.simulators; sys.exit('mujoco' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_where_mujoco_is_missing_the_command_says_how_to_install_it():
    words = ["simulate", "paper_bench", "-o", "s.h5", "--mujoco", "m.xml", "--geom", "g", "--site", "s"]
    code = f"import sys; sys.modules['mujoco'] = None; from calib.cli import main; sys.exit(main({words}))"
    found = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert found.returncode == 2
    assert "pip install 'jaxeit[mujoco]'" in found.stderr


BALL = """<mujoco><option timestep="0.005"/><worldbody>
  <geom name="board" type="box" size=".1 .1 .01"/><site name="sheet" pos="-.1 -.1 .01"/>
  <body pos="-.04 .03 .0395"><freejoint/><geom type="sphere" size=".03" mass="1.2" condim="6"/></body>
</worldbody></mujoco>"""


def test_the_command_records_what_the_skin_of_a_robot_reads(skin, tmp_path, capsys):
    """A session that begins untouched, and whose load is the weight of the ball."""
    (tmp_path / "robot.xml").write_text(BALL)
    (tmp_path / "scene.toml").write_text(
        'format = "jaxeit-scene"\nversion = 1\ntitle = "a ball"\nskin = "testbed"\nseed = 1\n'
        "[bench]\nblank = 0.5\neit_rate = 50.0\ncolumns = 2\nrows = 2\nmargin = 0.05\nforces = [10.0]\n"
        '[[effects]]\ntype = "LoadSpreading"\nwidth = 0.01\n[[effects]]\ntype = "ContactPiezoresistance"\n'
    )
    out, words = tmp_path / "session.h5", ["--geom", "board", "--site", "sheet", "--fidelity", "draft"]
    command = ["simulate", str(tmp_path / "scene.toml"), "-o", str(out), "--mujoco", str(tmp_path / "robot.xml")]
    assert main([*command, *words, "--seconds", "1"]) == 0
    with calib.open_session(out) as session:
        frames, pads, load = session.stream("eit").read(), session.stream("pressure").read(), session.truth["load"]
        assert session.simulated
        assert len(frames) == len(pads) == len(load) == 75
        assert session.skin_toml == skin.toml
    assert not load[:25].any()
    np.testing.assert_array_equal(frames[1:25], frames[:24])
    np.testing.assert_allclose(load[-10:], 1.2 * GRAVITY, rtol=0.02)
    assert np.abs(frames[-1] - frames[0]).max() > 1e-4 * np.abs(frames[0]).max()
    assert [pad.name for pad in skin.pads][pads[-1].argmax()] == "upper left"
    (tmp_path / "broken.xml").write_text(BALL.replace("sphere", "spere"))
    for wrong, said in (
        ([*words, "--seconds", "0"], "0 s are no recording"),
        (["--geom", "board"], "give --geom NAME"),
        ([*words, "--mujoco", str(tmp_path / "broken.xml")], "MuJoCo cannot read the model"),
        ([*words, "--jobs", "2"], "--jobs: an option of --random-scenes"),
        ([*words, "--random-scenes", "5"], "make different things"),
    ):
        assert main([*command, *wrong]) == 2
        assert said in capsys.readouterr().err

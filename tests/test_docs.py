"""The Python programs and commands of the documentation run as they stand."""

import re
import shlex
import signal
import subprocess
import sys
import tomllib
from contextlib import contextmanager
from functools import cache, reduce
from itertools import pairwise
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import calib
import jaxeit as je
from calib.cli import _parser, main
from calib.cli.recipe_options import recipe_of
from jaxeit.messages.missing_names import WORDS

FENCE = re.compile(r"^( *)```(\w*)(?: title=\"(.+?)\")?\n(.*?)^\1```", re.DOTALL | re.MULTILINE)
SHELL = ("sed ", "python ")
DECISIONS = sorted((Path(__file__).parents[1] / "docs").glob("which-*.md"))


def blocks(page):
    """Language, title and text of each fenced block of a page."""
    for indent, language, title, text in FENCE.findall(page.read_text(encoding="utf-8")):
        yield language, title, re.sub(rf"^{indent}", "", text, flags=re.MULTILINE)


def write_files(page, folder):
    """The blocks of a page that have a file name, as files."""
    for _, title, text in blocks(page):
        if title:
            (folder / title).write_text(text, encoding="utf-8")


@contextmanager
def served(words):
    """A simulated device in a process of its own; gives the addresses of its streams by option."""
    with subprocess.Popen([sys.executable, "-m", "calib.cli", *words], stdout=subprocess.PIPE, text=True) as device:
        try:
            yield dict(re.findall(r"(--\w+) (tcp://\S+)", device.stdout.readline()))
        finally:
            device.send_signal(signal.SIGINT)
            device.wait(20)


def follow_commands(text, served_words):
    """Run the lines of a block as a reader would. A device is served for the command that follows."""
    for line in text.replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        if line.startswith(SHELL):
            subprocess.run(line, shell=True, check=True)
        elif words[:1] == ["jaxeit"] and "--serve" in words:
            served_words[:] = words[1:]
        elif words[:1] == ["jaxeit"] and any("tcp://" in word for word in words):
            with served(served_words) as urls:
                given = [urls.get(before, word) for before, word in pairwise(words)]
                limits = {"live": ["--port", "0", "--seconds", "90"], "record": ["--seconds", "2"]}[given[0]]
                assert main([*given, *limits]) == 0, line
        elif words[:1] == ["jaxeit"]:
            assert main(words[1:]) == 0, line


def follow(page, folder):
    """Do what a page says, block by block, in a folder; returns the names that its programs define."""
    names, served_words = {}, []
    write_files(page, folder)
    for language, title, text in blocks(page):
        if language == "python" and not title:
            exec(compile(text, page.name, "exec"), names)
        elif not language:
            follow_commands(text, served_words)
    return names


@pytest.fixture(scope="module")
def touch(model):
    """What the programs about images take for given: a model, a touch at (60, 130) mm, the noise of the readings."""
    distance = jnp.linalg.norm(model.centroids - jnp.array([0.06, 0.13]), axis=1)
    v0 = je.forward(model)
    dv = je.forward(model, jnp.where(distance < 0.01, 1.5, 1) * model.background) - v0
    noise = jnp.full(len(v0), 1e-4 * float(jnp.abs(v0).max()))
    return {"je": je, "jnp": jnp, "model": model, "v0": v0, "dv": dv, "noise": noise, "distance": distance}


def force_error(table):
    """RMSE (N) of the first row "calibrated" that a command printed."""
    return float(re.search(r"calibrated \(.*?\) +[\d.]+ +\([\d.]+\) +([\d.]+)", table)[1])


@pytest.mark.slow
def test_an_own_skin_is_simulated_calibrated_and_shown_live(root, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names = follow(root / "docs" / "own-skin.md", tmp_path)
    told = capsys.readouterr()
    assert "Nothing wrong was found" in told.out
    assert 9 < names["picture"].sum() < 11
    assert int(re.findall(r"(\d+) frames$", told.err, re.MULTILINE)[-1]) > 0
    assert force_error(told.out.split("held out by session")[1]) < 0.1  # N
    follow(root / "docs" / "own-recordings.md", tmp_path)
    imported = capsys.readouterr().out
    assert "Presses  54 of 54 usable" in imported
    assert abs(force_error(imported) - force_error(told.out)) < 0.02


def test_the_files_of_an_own_skin_are_read(root, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_files(root / "docs" / "own-skin.md", tmp_path)
    bench = calib.load_bench("my_scene.toml")
    assert (len(bench.sites), len(bench.scene.skin.electrodes), len(bench.scene.skin.pads)) == (54, 12, 2)


def run(page, names):
    """Execute the programs of a page one after the other, and return what they defined."""
    for program in re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE):
        exec(compile(program, page.name, "exec"), names)
    return names


def test_programs_about_the_session_file(root, tmp_path, monkeypatch):
    """Those that write come first; the file of h5py alone holds the same."""
    monkeypatch.chdir(tmp_path)
    page = root / "data" / "schema" / "README.md"
    read, write, by_h5py = [text for language, _, text in blocks(page) if language == "python"]
    names: dict = {}
    for program in (write, by_h5py, read):
        exec(compile(program, page.name, "exec"), names)
    with calib.open_session("press.h5") as session, calib.open_session("by_h5py.h5") as other:
        assert session.skin_name == other.skin_name == "testbed"
        for found in (session.stream("force"), other.stream("force")):
            np.testing.assert_array_equal(found.read(), [[0.0], [0.5], [1.0]])
            np.testing.assert_array_equal(found.time, names["time"])


def test_the_page_of_scenes_lists_every_effect(root):
    page = root / "docs" / "scenes.md"
    head, *_ = page.read_text(encoding="utf-8").split("```toml")
    listed = re.findall(r"`(\w+)`", "".join(line for line in head.splitlines() if line.startswith("| ")))
    ours = (name for name, kind in je.effects.EFFECTS.items() if kind.__module__.startswith("jaxeit"))
    assert sorted(listed) == sorted(ours)
    ((_, _, scene),) = blocks(page)
    spread, hysteresis = je.toml.parse_toml(scene, "scene", je.model.read_effects)
    assert (float(spread.width), float(hysteresis.loop)) == (0.012, 0.1)


def rows_of(page):
    """Both cells of each row of the first table of a page."""
    table = re.search(r"(?:^\|.*\n)+", page.read_text(encoding="utf-8"), re.MULTILINE)[0]
    return [line.strip("| ").split(" | ") for line in table.splitlines()[2:]]


@pytest.mark.parametrize(("package", "page"), WORDS)
def test_words_of_other_packages_are_those_of_their_page(root, model, package, page):
    """Each function of the first column is known, with what stands beside it; what it names exists."""
    rows, words = rows_of(root / page), WORDS[package, page]
    for word, answer in words.items():
        assert any(
            re.search(rf"`[^`]*\b{word}\b", left) and re.search(rf"`[^`]*{re.escape(answer)}`", right)
            for left, right in rows
        ), word
        named = re.findall(r"\w+", answer.split("(")[0])[1:]
        assert reduce(getattr, named, je if answer.startswith("je.") else model) is not None
        with pytest.raises(AttributeError, match=rf"jaxeit has no {word}; for {word} of {package} write .*{page}"):
            getattr(je, word)
    functions = {name for left, _ in rows for name in re.findall(r"(?<![\w.])(\w+)(?:\.\w+)?\(", left)}
    assert functions - {"fmdl", "eit"} <= words.keys()  # objects of a user


def test_programs_about_places_of_electrodes(root):
    names = run(root / "docs" / "electrodes.md", {})
    by_slope = 1e-3 * np.asarray(names["slopes"][:, 7, 0])
    np.testing.assert_allclose(names["change"], by_slope, atol=0.1 * np.abs(by_slope).max())
    assert names["wider"].nodes.shape == names["model"].nodes.shape


def test_programs_about_proposals(root):
    found = run(root / "docs" / "proposal.md", {})["found"]
    assert found.kind is je.contacts.LoadKind.NONE
    assert np.sum(found.probability) == pytest.approx(1)


def test_programs_about_curves(root):
    names = run(root / "docs" / "fitting.md", {"calib": calib, "np": np})
    np.testing.assert_allclose(names["force"], 2e-3 * names["pressure"] ** 1.1, rtol=1e-5)


def test_programs_about_import(root, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "log.csv").write_text("time,load\n" + "".join(f"{k / 100},{k % 7}\n" for k in range(100)))
    run(root / "docs" / "import.md", {})
    with calib.open_session("session.h5") as session:
        assert session.streams["force"].read()[:, 0].tolist() == [k % 7 for k in range(100)]


@pytest.mark.slow
def test_programs_about_images_loads_and_tracks(root, model, skin, touch):
    frames = [(dv, 0.01, None, None) for dv in (0 * touch["dv"], touch["dv"], touch["dv"])]
    given = {"skin": skin, "frames": frames, "finder": je.prepare_contacts(model, noise=touch["noise"])}
    names = touch | given
    for page in ("images.md", "loads.md", "tracks.md"):
        run(root / "docs" / page, names)
    assert abs(float(names["figures"].position_error)) < 0.01
    assert 0.3 < float(names["likeness"]) <= 1
    place = jnp.array([0.06, 0.13])
    assert float(je.localisation_error(je.contacts.strongest(names["contacts"]), place)) < 0.01
    (track,) = names["now"].tracks
    np.testing.assert_allclose(track.position, place, atol=0.001)


# --- a page for each decision


def recipe_of_command(text):
    """The recipe that the command line of a page makes."""
    (line,) = [line for line in text.splitlines() if line.startswith("jaxeit calibrate ")]
    return recipe_of(_parser(["calibrate"]).parse_args(shlex.split(line)[1:]))


@pytest.fixture(scope="module")
def defined_by(root, skin, touch):
    """What the programs of a decision define, by the name of its page; each page is run once."""
    given = touch | {"calib": calib, "skin": skin}
    return cache(lambda name: run(root / "docs" / f"{name}.md", dict(given)))


@pytest.mark.parametrize("page", DECISIONS, ids=lambda page: page.stem)
def test_a_decision_has_its_default_first_one_table_and_two_ways_to_say_it(page, defined_by, root):
    text = page.read_text(encoding="utf-8")
    assert re.match(r"# Which [\w -]+\?\n\n\*\*(Default|Recommended): ", text)
    assert re.findall(r"^<!-- ([\w-]+): written by", text, re.MULTILINE) == [page.stem]
    assert f"- docs/{page.name}\n" in (root / "mkdocs.yml").read_text(encoding="utf-8")
    (python, _, _), (language, _, said) = blocks(page)
    assert python == "python"
    if page.stem != "which-scan":  # a scan is no choice of a recipe
        written = calib.Recipe.from_toml(said) if language == "toml" else recipe_of_command(said)
        assert written.to_toml() == defined_by(page.stem)["recipe"].to_toml() != calib.Recipe().to_toml()


def test_the_images_of_decisions_are_at_the_touch(defined_by):
    place = jnp.array([0.06, 0.13])
    for name in ("which-prior", "which-method", "which-precision"):
        names = defined_by(name)
        centroid = je.LevelCentroid(0.5)(names["image"], names["recon"])
        assert float(je.localisation_error(centroid.astype(float), place)) < 0.01, name


def test_the_curves_voltages_and_scans_of_decisions_are_as_said(defined_by, touch, root):
    curve = defined_by("which-curve")
    np.testing.assert_allclose(curve["force"], 2e-3 * curve["pressure"] ** 1.1, rtol=1e-5)
    largest = float(jnp.abs(touch["v0"]).max())
    np.testing.assert_allclose(defined_by("which-solver")["single"], touch["v0"], atol=1e-4 * largest)
    assert 1e-3 < float(defined_by("which-fidelity")["error"]) < 2e-2
    assert defined_by("which-scan")["protocol"].readings == 80
    assert defined_by("which-scan")["rate"] == pytest.approx(1250)
    (_, (_, _, protocol)) = blocks(root / "docs" / "which-scan.md")
    shipped = (root / "jaxeit" / "skin" / "skins" / "testbed.toml").read_text(encoding="utf-8")
    described = tomllib.loads(protocol)["protocol"]
    assert described == {key: tomllib.loads(shipped)["protocol"][key] for key in described}


@pytest.mark.slow
def test_the_command_lines_of_decisions_calibrate(root, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "session.h5").symlink_to(root / "data" / "sessions" / "testbed_grid.h5")
    for page in DECISIONS:
        write_files(page, tmp_path)
        lines = "".join(text for language, _, text in blocks(page) if not language)
        follow_commands(lines, [])
        if lines:
            assert calib.load_calibration("calibration.h5").recipe.to_toml() == recipe_of_command(lines).to_toml()
    assert main(["calibrate", "session.h5", "-o", "again.h5", "--recipe", "recipe.toml"]) == 0
    capsys.readouterr()

"""The Python programs and commands of the documentation run as they stand."""

import re
import shlex
import signal
import subprocess
import sys
from contextlib import contextmanager
from itertools import pairwise

import jax.numpy as jnp
import numpy as np
import pytest

import calib
import jaxeit as je
from calib.cli import main

FENCE = re.compile(r"^( *)```(\w*)(?: title=\"(.+?)\")?\n(.*?)^\1```", re.DOTALL | re.MULTILINE)
SHELL = ("sed ", "python ")


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
                limits = {"live": ["--port", "0", "--seconds", "40"], "record": ["--seconds", "2"]}[given[0]]
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
def test_programs_about_images(root, model):
    place = jnp.array([0.06, 0.13])
    distance = jnp.linalg.norm(model.centroids - place, axis=1)
    v0 = je.forward(model)
    dv = je.forward(model, model.background * (1 + 0.5 * (distance < 0.01))) - v0
    noise = jnp.full(len(v0), 1e-4 * float(jnp.abs(v0).max()))
    given = {"je": je, "jnp": jnp, "model": model, "v0": v0, "dv": dv, "noise": noise, "distance": distance}
    names = run(root / "docs" / "methods.md", given | {"finder": je.prepare_contacts(model, noise=noise)})
    assert abs(float(names["figures"].position_error)) < 0.01
    assert 0.3 < float(names["likeness"]) <= 1
    assert float(je.localisation_error(je.contacts.strongest(names["contacts"]), place)) < 0.01

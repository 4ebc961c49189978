"""What a release needs to be whole: one version everywhere, and a source archive from which the tests run."""

import os
import re
import subprocess
import sys
import tomllib
from importlib import metadata

import pytest

from .test_docs import blocks


def described(root):
    return tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def clone(root, tmp_path_factory):
    """A clone of the last commit, whose commands make an environment of its own."""
    folder = tmp_path_factory.mktemp("release")
    index = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--dest", str(folder), "setuptools"]
    if subprocess.run(index, capture_output=True, check=False).returncode:
        pytest.skip("no package index can be reached")
    if subprocess.run(["git", "clone", "-q", root, folder / "clone"], capture_output=True, check=False).returncode:
        pytest.skip("no checkout: this is a source archive")
    return folder / "clone"


def do(lines, folder, **more):
    """Run lines of a page in a folder with its own environment; returns what they say."""
    own = ("PYTEST", "PYTHON", "JAX", "VIRTUAL_ENV", "MAKE", "MFLAGS")
    env = {name: value for name, value in os.environ.items() if not name.startswith(own)}
    env |= {"PATH": f"{folder / '.venv' / 'bin'}{os.pathsep}{env['PATH']}"} | more
    done = subprocess.run(["bash", "-ec", lines], cwd=folder, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return done.stdout


@pytest.mark.slow
def test_the_commands_of_contributors(clone):
    """Those of CONTRIBUTING.md that are not the tests themselves."""
    first, *_ = blocks(clone / "CONTRIBUTING.md")
    lines = [line for line in first[-1].splitlines() if line.startswith(("make lint", "make docs"))]
    assert len(lines) == 2
    assert "Success: no issues found" in do("\n".join(lines), clone)
    assert (clone / "build" / "site" / "index.html").exists()


@pytest.mark.slow
def test_the_archives_of_a_release(clone, tmp_path):
    """With a part of the tests, in a folder in the place of /tmp."""
    do("make .venv/.dev", clone)
    (*_, links), (*_, archives) = blocks(clone / "docs" / "release.md")
    do(links, clone, REPOSITORY="https://example.org/jaxeit")
    assert "https://example.org/jaxeit/docs/" in (clone / "README.md").read_text(encoding="utf-8")
    said = do(archives.replace("/tmp", str(tmp_path)), clone, PYTEST_ADDOPTS="-k test_release")
    assert re.search(r"\b2 passed, \d+ skipped", said)
    assert len([*(clone / "dist").glob("jaxeit-*.whl")]) == 1
    assert "https://example.org" not in (clone / "README.md").read_text(encoding="utf-8")


def test_the_version_is_the_same_everywhere(root):
    version = described(root)["project"]["version"]
    assert metadata.version("jaxeit") == version
    citation = (root / "CITATION.cff").read_text(encoding="utf-8")
    assert re.search(r"^version: \"?([\d.]+)\"?$", citation, re.MULTILINE)[1] == version
    newest = re.search(r"^## ([\d.]+)", (root / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)[1]
    assert newest == version


def test_links_of_the_readme_become_whole_addresses(root, tmp_path):
    """By the command of the page on releases."""
    (_, _, command), _ = blocks(root / "docs" / "release.md")
    assert command.startswith("sed ")
    (tmp_path / "README.md").write_text((root / "README.md").read_text(encoding="utf-8"), encoding="utf-8")
    env = os.environ | {"REPOSITORY": "https://example.org/jaxeit"}
    subprocess.run(["bash", "-c", command], cwd=tmp_path, env=env, check=True)
    addresses = re.findall(r"\]\(([^)]*)\)", (tmp_path / "README.md").read_text(encoding="utf-8"))
    assert len(addresses) > 30
    for address in addresses:
        path, _, _ = address.removeprefix("https://example.org/jaxeit/").partition("#")
        assert path != address
        assert (root / path).exists(), address


def test_the_source_archive_holds_what_is_tracked(root):
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=root, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("no checkout: this is a source archive")
    lines = (root / "MANIFEST.in").read_text(encoding="utf-8").splitlines()
    words = [line.split() for line in lines if line and not line.startswith("#")]
    files = {name for command, *names in words if command == "include" for name in names}
    folders = {name for command, *names in words if command == "graft" for name in names}
    packages = described(root)["tool"]["setuptools"]["packages"]["find"]["include"]
    folders |= {name.rstrip("*") for name in packages}
    always = {"MANIFEST.in", "pyproject.toml", "README.md", "LICENSE"}  # setuptools takes them by itself
    tracked = listed.stdout.split("\0")[:-1]
    left_out = [path for path in tracked if path.split("/")[0] not in folders | files | always]
    assert left_out == []
    data = described(root)["tool"]["setuptools"]["package-data"]
    for path in tracked:
        package, *inside = path.split("/")
        if package in data and not path.endswith(".py"):
            name = "/".join(inside)
            assert any(re.fullmatch(p.replace(".", r"\.").replace("*", "[^/]*"), name) for p in data[package]), path

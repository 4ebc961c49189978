"""What a release needs to be whole: one version everywhere, and a source archive from which the tests run."""

import os
import re
import subprocess
import tomllib
from importlib import metadata

import pytest

from .test_docs import blocks


def described(root):
    return tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))


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

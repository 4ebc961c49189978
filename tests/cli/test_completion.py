"""The printed script completes what the parser knows, in a shell of its own."""

import re
import shutil
import subprocess
import sys

import pytest

from calib.cli import COMMANDS, main
from calib.fitting import CURVES

TRIAL = """
source "$1"
shift
COMP_WORDS=("$@")
COMP_CWORD=$((${#COMP_WORDS[@]} - 1))
_shtab_jaxeit
printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.fixture(scope="module")
def script(tmp_path_factory):
    path = tmp_path_factory.mktemp("completion") / "jaxeit.bash"
    command = [sys.executable, "-m", "jaxeit", "completion", "bash"]
    path.write_text(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    return path


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash on this machine")
@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["re"], {"recalibrate", "record", "recover"}),
        ([""], {*COMMANDS}),
        (["calibrate", "--cur"], {"--curve"}),
        (["calibrate", "--curve", ""], {*CURVES.shipped, "auto", "memoryless"}),
        (["calibrate", "--hyperparameter", "l"], {"l-curve"}),
        (["import", "par"], {"parquet"}),
        (["export", "m"], {"mcap"}),
        (["completion", ""], {"bash", "zsh", "tcsh"}),
        (["check", "ses"], {"session.h5"}),
        (["calibrate", "session.h5", "-o", "ses"], {"session.h5"}),
    ],
)
def test_bash_completes(script, words, expected, tmp_path):
    (tmp_path / "session.h5").touch()
    command = ["bash", "-c", TRIAL, "trial", str(script), "jaxeit", *words]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) - {"-h", "--help", "--version"} == expected


def test_other_shells(capsys):
    assert main(["completion", "zsh"]) == 0
    assert capsys.readouterr().out.startswith("#compdef jaxeit")
    assert main(["completion", "tcsh"]) == 0
    assert re.search(r"^complete jaxeit", capsys.readouterr().out, re.MULTILINE)


def test_what_is_missing_is_said(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "shtab", None)
    assert main(["completion", "bash"]) == 2
    assert "pip install 'jaxeit[completion]'" in capsys.readouterr().err

"""Commands that the program and its pages print run as they are printed."""

import argparse
import ast
import re
import shlex
import signal
import subprocess
import sys

import pytest

from calib.cli import COMMANDS, _parser, main

WORD = r"(?:'[^']*'|[^\s`'\";,|)(]+)"
COMMAND = re.compile(rf"jaxeit ({'|'.join(COMMANDS)})\b((?: {WORD})*)")


def parser_of(command):
    """The parser of one command."""
    parser = _parser([command])
    (commands,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    return commands.choices[command]


def printed_strings(root):
    """Every text in the source, with `X` for what is filled in when it is printed, and where it is."""
    for package in ("calib", "jaxeit"):
        for path in sorted((root / package).rglob("*.py")):
            tree = ast.parse(path.read_text())
            docs = {
                ast.get_docstring(n, clean=False)
                for n in ast.walk(tree)
                if isinstance(n, (ast.Module, ast.FunctionDef, ast.ClassDef))
            }
            for node in ast.walk(tree):
                if isinstance(node, ast.JoinedStr):
                    text = "".join(v.value if isinstance(v, ast.Constant) else "X" for v in node.values)
                elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value not in docs:
                    text = node.value
                else:
                    continue
                yield path.relative_to(root), text


def test_commands_named_in_messages_know_their_options(root):
    found = 0
    for path, text in printed_strings(root):
        for command, rest in COMMAND.findall(text):
            known = {option for action in parser_of(command)._actions for option in action.option_strings}
            given = {word.split("=")[0] for word in rest.split() if word.startswith("--")}
            assert given <= known, f"{path}: {text!r}"
            found += 1
    assert found >= 10


def commands_of(text):
    """Lines `jaxeit ...` of fenced blocks and of the first column of tables, without what explains them."""
    rows = "\n".join(re.findall(r"^\| `(jaxeit .*?)` \|", text, re.MULTILINE))
    for block in [*re.findall(r"^```\w*\n(.*?)^```", text, re.MULTILINE | re.DOTALL), rows]:
        for line in re.sub(r"\\\n *", "", block).splitlines():
            words = re.split(r"(?<=\S) {3,}(?=\S)|  #", line.removeprefix("$ ").strip())[0]
            if words.startswith("jaxeit ") and not re.search(r"\[|\.\.\.|…", words):
                yield words


def pages(root):
    return [root / "README.md", *sorted((root / "docs").glob("*.md"))]


def is_parsed(words):
    """Whether a command takes its words; `--help` and `--version` end well too."""
    try:
        _parser(words).parse_args(words)
    except SystemExit as stopped:
        return stopped.code == 0
    return True


def test_commands_of_the_pages_are_parsed(root):
    lines = [(page.name, line) for page in pages(root) for line in commands_of(page.read_text())]
    refused = [(page, line) for page, line in lines if not is_parsed(shlex.split(re.sub(r"\s#.*", "", line))[1:])]
    assert refused == []
    assert len(lines) >= 10


@pytest.fixture
def served(presses_session, tmp_path):
    """The line that a served session prints."""
    command = [sys.executable, "-m", "calib.cli", "simulate", "ideal", "-o", str(presses_session), "--serve"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as serving:
        try:
            yield serving.stdout.readline()
            serving.send_signal(signal.SIGINT)
            assert serving.wait(20) == 0
        finally:
            serving.kill()


@pytest.fixture
def presses_session(bundled, tmp_path):
    (source,) = (path for path in bundled if path.stem == "testbed_presses")
    path = tmp_path / "a session.h5"
    path.write_bytes(source.read_bytes())
    return path


def test_the_record_line_of_a_served_scene_records(served, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = shlex.split(served[served.index("jaxeit record") :])
    assert main([*words[1:], "--seconds", "0.5"]) == 0
    assert (tmp_path / "recorded.h5").exists()
    assert "eit" in capsys.readouterr().out


def test_the_record_line_of_the_readme_records(served, root, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    urls = re.findall(r"tcp://\S+", served)
    (line,) = (x for x in commands_of((root / "README.md").read_text()) if x.startswith("jaxeit record"))
    for url in urls[: line.count("URL")]:
        line = line.replace("URL", url, 1)
    assert main([*shlex.split(line)[1:], "--seconds", "0.5"]) == 0
    capsys.readouterr()

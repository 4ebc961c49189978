"""`jaxeit completion`."""

import argparse

SHELLS = ("bash", "zsh", "tcsh")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The shell."""
    parser.add_argument("shell", choices=SHELLS, help="the shell for which the script is")
    parser.epilog = "bash: jaxeit completion bash > ~/.local/share/bash-completion/completions/jaxeit"


def run(args: argparse.Namespace) -> int:
    """Print the script. It is made once and then needs neither Python nor this package, so that completion is quick."""
    try:
        import shtab
    except ImportError:
        raise ImportError("completion needs shtab, which is not installed: pip install 'jaxeit[completion]'") from None
    from ... import COMMANDS, parser_with

    parser = parser_with(COMMANDS)
    _suggest(parser, shtab.FILE)
    print(shtab.complete(parser, args.shell))
    return 0


def _suggest(parser: argparse.ArgumentParser, files: object) -> None:
    """Names for options that take a name, and file names for all others that take a word; of subcommands too."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                _suggest(command, files)
        elif action.nargs != 0 and not action.choices:
            names = vars(action).get("suggestions")
            vars(action).update({"choices": names} if names else {"complete": files})

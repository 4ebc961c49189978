"""The error of all session and result files, and text from files made safe to print."""

from pathlib import Path


class SessionError(ValueError):
    """A file or a value cannot be used: ``<file name>: <where>: <what>; <what to do>``.

    Example:
        try:
            calib.open_session("nowhere.h5")
        except calib.SessionError as error:
            print(error)
    """


def printable(text: object, limit: int = 80) -> str:
    """`text` as one line without control characters; names in a file are not trusted."""
    line = "".join(c if c.isprintable() else "?" for c in str(text))
    return line if len(line) <= limit else line[: limit - 3] + "..."


def problem(path: object, where: str, what: str, todo: str) -> SessionError:
    """A `SessionError` in the form that all of them have."""
    name = printable(Path(str(path)).name or path)
    return SessionError(f"{name}: {printable(where)}: {printable(what, 300)}; {todo}")

"""Names of a room that are imported on first use, so that a command loads only the modules that it needs."""

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any


def lazy_names(
    room: str, modules: Mapping[str, str], rooms: Sequence[str] = ()
) -> tuple[Callable[[str], Any], list[str]]:
    """``__getattr__`` and ``__all__`` of a room.

    Args:
        room: ``__name__`` of the room.
        modules: public names, separated by spaces, for each module of the room.
        rooms: rooms inside this one that are public names themselves.
    """
    home = {name: module for module, names in modules.items() for name in names.split()}

    def get(name: str) -> Any:
        if name in rooms:
            return import_module(f".{name}", room)
        if name not in home:
            raise AttributeError(f"module {room!r} has no attribute {name!r}")
        return getattr(import_module(f".{home[name]}", room), name)

    return get, sorted((*home, *rooms))

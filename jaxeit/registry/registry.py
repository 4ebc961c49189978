"""Classes of one kind by the names that files and the command line use.

A registry does not list its classes: it collects them from the package that defines them, so that a new class is known
as soon as its module is imported, or named in the stub of a room whose names are imported on first use.  Other packages
add classes by entry points, and users name a class of their own by its import path, ``my_package.my_module:MyEffect``.
One reader serves TOML tables (``type = "Creep"`` and its settings) and words of the command
line (``greit:width=0.01,radius=0.02``).
"""

import functools
import importlib
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING
from importlib.metadata import EntryPoint, entry_points
from inspect import isabstract, isclass
from typing import Any, Generic, TypeVar, cast

from ..messages.spelling import did_you_mean
from ..toml import TomlError, TomlTable, parse_values
from .settings import Part, fields_of, settings_of

T = TypeVar("T")


class RegistryError(ValueError):
    """An unknown name, or a class of another kind; the message says what to do."""


class Registry(Mapping[str, type[T]], Generic[T]):
    """Classes that can be chosen by name: a mapping from names to classes.

    Shipped classes are the concrete classes derived from ``base`` in its package.  A class states its name as
    ``name: ClassVar[str]``; without it, ``spell`` makes the name from that of the class.

    Args:
        base: the class from which all classes of this kind derive.
        kind: the noun for such a class in messages, such as "effect".
        group: the group of entry points by which other packages add classes.
        spell: makes the name of a class that states none; default: `TotalVariation` is "total-variation".
        parts: registries of the objects that settings may hold.
        words: short words that `make` takes for a choice with its settings, as "half" for "level-centroid:level=0.5".

    Example:
        from jaxeit.registry import AbstractChoice, Registry, computed


        class AbstractFirmness(AbstractChoice):  # a kind of choice of your own
            bulk: float | None = computed()  # found later by the class itself, never by text


        FIRMNESSES = Registry(AbstractFirmness, "firmness", "my_package.firmnesses")
        print(list(FIRMNESSES))  # its classes in your package, and those of entry points
    """

    def __init__(
        self,
        base: Callable[..., T],
        kind: str,
        group: str,
        spell: Callable[[str], str] | None = None,
        parts: tuple[Part, ...] = (),
        words: Mapping[str, str] | None = None,
    ):
        self.base = cast(type[T], base)  # declared as a function, since mypy refuses an abstract class as `type[T]`
        self.kind, self.group, self.parts = kind, group, parts
        self.words: Mapping[str, str] = dict(words or {})
        self._spell = spell or kebab_case
        self._room = base.__module__.rpartition(".")[0] + "."

    def __repr__(self) -> str:
        return f"Registry({self.base.__name__}: {', '.join(self.names)})"

    # --- names and classes -------------------------------------------------------------------------------------------

    @property
    def shipped(self) -> dict[str, type[T]]:
        """The classes of the package by name, in the order in which they are defined."""
        _import_on_demand(self._room[:-1])
        modules = [module for name, module in list(sys.modules.items()) if name.startswith(self._room)]
        classes = [(thing, module) for module in modules for thing in vars(module).values() if isclass(thing)]
        own = [cast(type[T], kind) for kind, module in classes if kind.__module__ == module.__name__]
        return {self._stated_name(kind): kind for kind in own if self._is_choice(kind)}

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the shipped and of the installed classes."""
        return tuple(dict.fromkeys((*self.shipped, *_entry_points(self.group))))

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, name: str) -> type[T]:
        if name not in self.names:
            raise KeyError(name)
        return self.find(name)

    def find(self, name: str, allow_import: bool = False, text: str = "") -> type[T]:
        """The class of a name: a shipped class, an installed class, or one named by its import path.

        Args:
            text: the whole word that the name begins, for messages; default: the name alone.
            allow_import: whether the module of an import path may be imported, which runs its code.  Set it for text
                that the user wrote, not for text that a session or calibration file holds.

        Raises:
            RegistryError: for an unknown name, naming the nearest one; for an import path that leads to no such class.
        """
        shipped, installed = self.shipped, _entry_points(self.group)
        if name in shipped:
            return shipped[name]
        if name in installed:
            return self._checked(_loaded(installed[name], self.kind), name)
        if ":" in name:
            return self._checked(self._by_path(name, allow_import), name)
        raise RegistryError(f"no {self.kind} {name!r}; {self._hint(name, text or name)}")

    def _hint(self, name: str, text: str) -> str:
        """What may be meant by an unknown name that begins a word: an object of a setting, or a class of this kind."""
        for own, kind in self.shipped.items():
            for setting in settings_of(kind, self.parts).values():
                part = setting.part
                if isinstance(part, Registry) and name in (*part.names, *part.words):
                    return f"{name!r} is known as {part.kind}: write '{own}:{setting.name}={text}'"
        module, dot, own = name.rpartition(".")
        names = (*self.names, *self.words)
        known = ", ".join(f'"{known}"' for known in names)
        path = f"write a class of your own as {module + ':' + own!r}"
        return did_you_mean(name, names, path if dot else f"give one of {known}")

    def name_of(self, thing: T | type[T]) -> str:
        """The name of a class or of an object's class; its import path if it is neither shipped nor installed."""
        kind: type = thing if isinstance(thing, type) else type(thing)
        stated = self._stated_name(kind)
        if self.shipped.get(stated) is kind:
            return stated
        path = f"{kind.__module__}:{kind.__qualname__}"
        return next((point.name for point in _entry_points(self.group).values() if point.value == path), path)

    def _is_choice(self, thing: Any) -> bool:
        if not (isclass(thing) and issubclass(thing, self.base)):
            return False
        return not isabstract(thing) and not thing.__name__.startswith(("Abstract", "_"))

    def _stated_name(self, kind: type) -> str:
        stated = vars(kind).get("name")
        return stated if isinstance(stated, str) else self._spell(kind.__name__)

    def _by_path(self, path: str, allow_import: bool) -> Any:
        module, _, attribute = path.partition(":")
        if module not in sys.modules and not allow_import:
            raise RegistryError(
                f"{self.kind} {path!r} is code outside jaxeit, which a data file cannot import; import {module} first, "
                f"or install it with an entry point of the group {self.group!r}"
            )
        try:
            return functools.reduce(getattr, attribute.split("."), _imported(module))
        except (ModuleNotFoundError, AttributeError) as error:
            why, todo = _one_line(error), "check the path and PYTHONPATH"
        except _ModuleError as error:
            why, todo = str(error), "correct that module"
        raise RegistryError(f"{self.kind} {path!r} cannot be imported ({why}); {todo}")

    def _checked(self, thing: Any, name: str) -> type[T]:
        if not self._is_choice(thing):
            lacks = ", ".join(sorted(getattr(thing, "__abstractmethods__", ())))
            what = f"is not a concrete class derived from {self.base.__name__}" + (
                f": it lacks {lacks}" if lacks else ""
            )
            raise RegistryError(f"{self.kind} {name!r} {what}")
        try:
            fields_of(thing)
        except ValueError as error:
            raise RegistryError(f"{self.kind} {name!r}: {error}") from None
        checked: type[T] = thing
        return checked

    # --- from text to objects and back -------------------------------------------------------------------------------

    def make(self, text: str, allow_import: bool = False, **given: Any) -> T:
        """The object that a word describes: a name, then settings as in ``sparse-bayes:steps=30``; or a short word.

        Args:
            given: fields that do not come from the text.

        Raises:
            ValueError: for a name or a setting that does not exist, or a value of the wrong kind.
        """
        name, settings = split_word(self.words.get(text, text))
        kind = self.find(name, allow_import, text)
        return _made(kind, TomlTable(settings, f"{self.kind} {text!r}", allow_import), given, self.parts)

    def read(self, table: TomlTable, **given: Any) -> T:
        """The object that a TOML table describes: ``type`` and its settings.

        Raises:
            TomlError: for a name or a setting that does not exist, or a value of the wrong kind.
        """
        name = table.get("type", lambda v: isinstance(v, str), f"the {self.kind}'s name")
        try:
            kind = self.find(name, table.allow_import)
        except RegistryError as error:
            raise table.error("type", str(error)) from None
        return _made(kind, table, given, self.parts)

    def settings(self, thing: T) -> dict[str, Any]:
        """The table from which `read` makes the object again: ``type``, and numbers, texts, lists and tables."""
        known = settings_of(type(thing), self.parts).values()
        values = {setting.name: setting.plain(getattr(thing, setting.name)) for setting in known}
        return {"type": self.name_of(thing)} | {name: value for name, value in values.items() if value is not None}

    def text(self, thing: T) -> str:
        """The word from which `make` makes the object again: its name, and settings that differ from their defaults."""
        known = settings_of(type(thing), self.parts).values()
        values = [(setting, getattr(thing, setting.name)) for setting in known]
        words = [f"{s.name}={s.word(value)}" for s, value in values if not s.is_default(value)]
        return self.name_of(thing) + (":" + ",".join(words) if words else "")


def from_words(kind: type[T], text: str, where: str) -> T:
    """An object of this class with the settings of words such as ``most=5,persistence=1``.

    Args:
        where: what is named in errors, such as the option of the command line.

    Raises:
        ValueError: for a setting that does not exist, or a value of the wrong kind.

    Example:
        settings = je.registry.from_words(je.contacts.ContactSettings, "most=3,columns=41", "--contacts")
    """
    return _made(kind, TomlTable(_pairs(text), f"{where} {text}"), {}, ())


def kebab_case(name: str) -> str:
    """``TotalVariation`` -> ``total-variation``, ``LCurve`` -> ``l-curve``."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "-", name).lower()


class _ModuleError(Exception):
    """A module is there and raises when it is imported; the message is what it raises."""


def _imported(module: str) -> Any:
    """The module of this name; raises ModuleNotFoundError if it is not there, and `_ModuleError` if it raises."""
    if not all(part.isidentifier() for part in module.split(".")):
        raise ModuleNotFoundError(f"No module named {module!r}")
    try:
        return importlib.import_module(module)
    except (Exception, SystemExit) as error:  # a user's module may raise anything
        if isinstance(error, ModuleNotFoundError) and f"{module}.".startswith(f"{error.name}."):
            raise
        raise _ModuleError(f"{module} raises {_with_type(error)}") from None


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def _with_type(error: BaseException) -> str:
    name = type(error).__name__
    return f"{name}: {said}" if (said := _one_line(error)) != name else name


def _made(kind: type[T], table: TomlTable, given: Mapping[str, Any], parts: tuple[Part, ...]) -> T:
    """An object of this class with the settings of the table; refuses all other keys."""
    known = settings_of(kind, parts)
    own = fields_of(kind)
    required = {f.name for f in own if f.default is MISSING and f.default_factory is MISSING}
    for missing in required - set(known) - set(given):
        raise table.error(missing, f"text cannot give this field of {kind.__name__}; make the object in Python")
    asked = [s for name, s in known.items() if name not in given and (name in required or table.has(name))]
    values = {setting.name: setting.read(table) for setting in asked}
    table.done()
    try:
        return kind(**values, **given)
    except (ValueError, TypeError) as error:
        raise table.error(kind.__name__, _one_line(error).removeprefix(f"{kind.__name__}: ")) from None


@functools.cache
def _import_on_demand(room: str) -> None:
    """Import the modules of a room whose names are imported on first use, so that their classes are found.

    The package at the top is left out: it has names of all rooms, and each room has registries of its own.
    """
    package = sys.modules.get(room) if "." in room else None
    if package is not None and hasattr(package, "__getattr__"):
        for name in package.__all__:
            getattr(package, name)


@functools.cache
def _entry_points(group: str) -> Mapping[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=group)}


def _loaded(point: EntryPoint, kind: str) -> Any:
    try:
        return point.load()
    except Exception as error:  # another package may raise anything
        why = _one_line(error) if isinstance(error, ImportError | AttributeError) else _with_type(error)
        raise RegistryError(f"{kind} {point.name!r}: {point.value} cannot be loaded ({why})") from None


def split_word(text: str) -> tuple[str, dict[str, Any]]:
    """The name, which may be an import path, and the settings of ``name:key=value,...``.

    Example:
        print(je.registry.split_word("sparse-bayes:steps=30"))
    """
    name, _, rest = text.partition(":")
    head, _, tail = rest.partition(":")
    if head and "=" not in head:
        name, rest = f"{name}:{head}", tail
    return name, _pairs(rest)


def _pairs(text: str) -> dict[str, Any]:
    """The values of ``key=value,...`` by their keys."""
    pairs = [pair.partition("=") for pair in re.split(r",(?![^\[]*\])", text) if pair.strip()]
    return {key.strip(): _value(value.strip()) for key, _, value in pairs}


def _value(text: str) -> Any:
    """A value as TOML writes it; a text needs no quotes."""
    try:
        return parse_values(f"value = {text}", "value")["value"]
    except TomlError:
        return text

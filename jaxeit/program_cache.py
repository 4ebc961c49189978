"""Programs of verbs on disk, found without tracing the verbs anew."""

import os
import pickle
import platform
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from enum import Enum
from functools import wraps
from hashlib import sha256
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from io import BytesIO
from operator import attrgetter
from pathlib import Path
from shutil import rmtree
from types import BuiltinFunctionType, FunctionType
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.export import deserialize, export

# Packages whose code a program may depend on. The sources of ours are hashed, the others have versions.
_OURS = ("jaxeit", "calib")
_OTHERS = ("jax", "jaxlib", "numpy", "scipy", "equinox", "optimistix", "lineax", "jaxtyping")
_KNOWN = {*_OURS, *_OTHERS, *sys.stdlib_module_names} - {"__main__"}

# Settings of JAX that say where programs are kept and what is reported, not what is computed.
_REPORTING = ("cache", "log", "dump", "traceback", "explain", "profil", "pprint")

UNUSED_DAYS = 30
"""Programs of other versions are removed when no process has used them for so many days."""

_folder: Path | None = None
_changes = 0  # of the folder


def cache_programs(folder: str | os.PathLike[str] | None) -> None:
    """Keep the programs of verbs in ``folder``, for this process and later ones; None: keep none from now on.

    JAX's own cache (``jax_compilation_cache_dir``) keeps what XLA has compiled. To find a program there, JAX traces and
    lowers the verb, which takes half of the time of most commands. Here the lowered program is found by the verb, the
    shapes and types of arrays, all other arguments, the source of this package, the versions of the packages below it
    and the settings of JAX. Programs of `bind` made after this call are kept likewise. Use both caches together, as the
    commands do with ``~/.cache/jaxeit``.

    A call is traced as ever where a verb or an argument is of a module of your own, since a change of its code would
    not be noticed, inside transformations of JAX, and where JAX has other devices than one CPU. Take a folder that
    only you can write, because the programs in it are run.

    Args:
        folder: made where it does not exist.

    Raises:
        OSError: the folder cannot be made.

    Example:
        je.cache_programs("programs")
        print(je.forward(model))  # traced once, and not again in the next process
    """
    global _folder, _changes
    _changes += 1
    _folder = None
    if folder is not None:
        _remove_unused(Path(folder))
        own = Path(folder) / f"programs-{_fingerprint()}"
        own.mkdir(mode=0o700, parents=True, exist_ok=True)
        os.utime(own)
        _folder = own


def programs_folder() -> Path | None:
    """Where programs are kept; None: nowhere."""
    return None if _folder is None else _folder.parent


def changes_of_folder() -> int:
    """How often a folder was set. What was traced before a change is traced anew after it."""
    return _changes


def keep(function: Callable[..., Any], known: Callable[..., Any]) -> Callable[..., Any]:
    """``function``, which finds its program in the folder when JAX traces it, and is traced itself if there is none.

    Args:
        function: what is computed.
        known: the function that users call, by whose name a program is found.
    """

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        if _folder is None:
            return function(*args, **kwargs)
        leaves, structure = jax.tree.flatten((args, kwargs))
        program = _program(_folder, function, known, leaves, structure)
        return function(*args, **kwargs) if program is None else program(leaves)

    return call


def unbound(result: Any) -> Any:
    """A result whose arrays are bound to no device, as those of a program that was traced.

    JAX 0.10 binds what an exported program returns to the device that it ran on, and compiles every program anew for
    arrays that are bound.
    """
    return jax.tree.map(lambda leaf: _unbound(leaf) if _is_bound(leaf) else leaf, result)


def _is_bound(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array) and not isinstance(leaf, jax.core.Tracer) and leaf.committed


def _unbound(array: Any) -> Any:
    """The same numbers, not copied. `jax.device_put` of the host's view would lose the weak type."""
    try:
        return type(array)(array.aval, array.sharding, [array], committed=False, _skip_checks=True)
    except (AttributeError, TypeError):  # a JAX that makes arrays in another way: programs may be compiled twice
        return array


class _Array(Enum):
    """Stands for an array in the arguments or the result of a program."""

    ARRAY = "array"


_ARRAY = _Array.ARRAY


def _program(
    folder: Path, function: Callable[..., Any], known: Callable[..., Any], leaves: list[Any], structure: Any
) -> Callable[[list[Any]], Any] | None:
    """The program of a call: from the folder, or traced and written there; None where it cannot be kept."""
    name = _name(known, leaves, structure) if _is_plain(leaves) else None
    if name is None:
        return None
    path = folder / name
    text = _read(path)
    if text is None:
        text = _traced(function, leaves, structure)
        if text is None:
            return None
        with suppress(OSError):  # a full disk costs time, and no result
            spare = path.with_name(f"{name}.{os.getpid()}")
            spare.write_bytes(sha256(text).digest() + text)
            spare.replace(path)
    return _runnable(text)


def _is_plain(leaves: list[Any]) -> bool:
    """Whether JAX would run these arguments as a compiled program on the only CPU there is."""
    settings = jax.config.values
    special = settings["jax_disable_jit"] or settings["jax_debug_nans"] or settings["jax_debug_infs"]
    keys = any(not isinstance(leaf.dtype, np.dtype) for leaf in filter(eqx.is_array, leaves))  # random ones
    return not special and not keys and [device.platform for device in jax.devices()] == ["cpu"]


def _read(path: Path) -> bytes | None:
    """A program as bytes; None if there is none, or the file is damaged."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    return content[32:] if sha256(content[32:]).digest() == content[:32] else None


def _traced(function: Callable[..., Any], leaves: list[Any], structure: Any) -> bytes | None:
    """The lowered program of a call and the form of its result, as bytes; None if they cannot be written."""
    forms: list[Any] = []

    def flat(*arrays: Any) -> list[Any]:
        given = iter(arrays)
        args, kwargs = jax.tree.unflatten(structure, [next(given) if eqx.is_array(leaf) else leaf for leaf in leaves])
        found, form = jax.tree.flatten(function(*args, **kwargs))
        forms.append(jax.tree.unflatten(form, [_ARRAY if eqx.is_array(leaf) else leaf for leaf in found]))
        return list(filter(eqx.is_array, found))

    shapes = [
        jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, weak_type=jax.typeof(leaf).weak_type)
        for leaf in filter(eqx.is_array, leaves)
    ]
    try:
        program = export(jax.jit(flat))(*shapes)
        weak = [result.weak_type for result in program.out_avals]
        text = BytesIO()
        _Pickler(text).dump((program.serialize(), weak, forms[-1]))
        written: Any = jax.tree.structure(pickle.loads(text.getvalue())[-1])
        return text.getvalue() if written == jax.tree.structure(forms[-1]) else None
    except Exception:  # the verb refuses its arguments, or returns or calls what cannot be written
        return None


class _Pickler(pickle.Pickler):
    """Writes the tags of lineax as their names, because JAX compares them by identity."""

    def reducer_override(self, value: Any) -> Any:
        return (_tag, (repr(value),)) if type(value).__module__ == "lineax._tags" else NotImplemented


def _tag(name: str) -> Any:
    return getattr(import_module("lineax"), name)


def _runnable(text: bytes) -> Callable[[list[Any]], Any]:
    """The function of the leaves of a call that runs a program."""
    written, weak, result = pickle.loads(text)
    program = deserialize(written)
    # A program is written without weak types. With a cache, results promote other arrays as they do without one.
    types = tuple(one.update(weak_type=is_weak) for one, is_weak in zip(program.out_avals, weak, strict=True))
    lowered: Callable[..., Any] = replace(program, out_avals=types).call
    parts, form = jax.tree.flatten(result)

    def call(leaves: list[Any]) -> Any:
        found = iter(lowered(*filter(eqx.is_array, leaves)))
        return jax.tree.unflatten(form, [next(found) if part is _ARRAY else part for part in parts])

    return call


def _name(known: Callable[..., Any], leaves: list[Any], structure: Any) -> str | None:
    """The file of a program: a hash of what it depends on beside `_fingerprint`; None where code is not known."""
    settings = {name: str(value) for name, value in jax.config.values.items() if not _is_reporting(name)}
    arguments = jax.tree.unflatten(structure, [_kind(leaf) for leaf in leaves])
    text = BytesIO()
    try:
        _require_known(known)
        _Description(text).dump((known.__module__, known.__qualname__, arguments, settings))
    except Exception:  # of many kinds, for what pickle cannot write
        return None
    return sha256(text.getvalue()).hexdigest()


def _kind(leaf: Any) -> Any:
    """What a program depends on of a leaf of the arguments."""
    if eqx.is_array(leaf):
        return (_ARRAY, leaf.shape, leaf.dtype, jax.typeof(leaf).weak_type)
    return (type(leaf).__name__, leaf)  # 1 is no 1.0


def _is_reporting(setting: str) -> bool:
    return any(word in setting for word in _REPORTING)


class _Description(pickle.Pickler):
    """What a program depends on, as bytes that equal values share in every process.

    A class or function is written as its name, which says what it does only where its code is known.
    """

    def __init__(self, file: BytesIO):
        super().__init__(file, protocol=5)
        self.fast = True  # a value that occurs twice is written twice, whether or not it is one object

    def persistent_id(self, value: Any) -> Any:
        if isinstance(value, type | FunctionType | BuiltinFunctionType):
            _require_known(value)
        if isinstance(value, set | frozenset):  # whose order differs between processes
            return (type(value).__name__, sorted(map(repr, value)))
        return None


def _require_known(code: Any) -> None:
    """Refuse a class or function whose name does not lead to it, or whose package is neither ours nor has a version."""
    module = code.__module__ or ""
    named = attrgetter(code.__qualname__)(sys.modules[module]) if module.partition(".")[0] in _KNOWN else None
    if named is None or named not in (code, getattr(code, "__wrapped__", None)):
        raise pickle.PicklingError(f"{code.__qualname__} of {module} is not known")


def _fingerprint() -> str:
    """What all programs depend on: sources, versions and the machine."""
    found = sha256()
    for package in _OURS:
        spec = find_spec(package)
        for folder in (spec.submodule_search_locations or ()) if spec else ():
            for file in sorted(Path(folder).rglob("*.py")):
                found.update(f"{file.relative_to(folder)}\n".encode() + file.read_bytes())
    found.update(repr([version(name) for name in _OTHERS]).encode())
    found.update(repr((sys.version, platform.machine(), os.cpu_count())).encode())
    return found.hexdigest()[:16]


def _remove_unused(folder: Path) -> None:
    for other in folder.glob("programs-*"):
        if time.time() - other.lstat().st_mtime > UNUSED_DAYS * 86400:
            rmtree(other, ignore_errors=True)

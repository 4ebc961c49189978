"""What a command sets up before its first computation; the library itself never does."""

import os
import stat
import warnings
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import jax

import jaxeit as je
from jaxeit.program_cache import programs_folder


def set_up() -> None:
    """64-bit numbers, memory that is used again, one thread of BLAS, and compiled programs kept between runs."""
    jax.config.update("jax_enable_x64", True)
    je.reuse_memory()
    je.limit_blas_threads()
    folder = cache_folder()
    if folder is not None:
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
        keep_programs(folder)


def set_up_batches() -> None:
    """As `set_up`, with a device of JAX for each core, so that batches of solutions occupy them all.

    To be called before anything is computed; later, or where the environment states a number, nothing changes.
    """
    set_up()
    if "host_platform_device_count" not in os.environ.get("XLA_FLAGS", ""):
        with suppress(RuntimeError):
            jax.config.update("jax_num_cpu_devices", os.cpu_count() or 1)


def set_up_live() -> None:
    """As `set_up`, and each program runs in the thread that calls it.

    A frame's programs take less time than it takes to wake another thread on a busy machine. To be called before
    anything is computed.
    """
    set_up()
    jax.config.update("jax_cpu_enable_async_dispatch", False)


_SETTINGS = (
    "jax_enable_x64",
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)

_PROGRAMS = "programs"


def settings() -> dict[str, Any]:
    """Those of JAX on which results and the time to compile depend, and where programs are kept."""
    return {name: getattr(jax.config, name) for name in _SETTINGS} | {_PROGRAMS: programs_folder()}


def take_over(wanted: Mapping[str, Any]) -> None:
    """Make this process, a worker, set up as the one whose `settings` these are."""
    for name in _SETTINGS:
        if getattr(jax.config, name) != wanted[name]:
            jax.config.update(name, wanted[name])
    if programs_folder() != wanted[_PROGRAMS]:
        keep_programs(wanted[_PROGRAMS])


def keep_programs(folder: Path | None) -> None:
    """`je.cache_programs`, where a folder that cannot be made costs time and no result."""
    with suppress(OSError):
        je.cache_programs(folder)


def cache_folder() -> Path | None:
    """A folder that only this user can write, or None: a program put there by others would be run."""
    root = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    folder = Path(root) / "jaxeit"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = folder.lstat()
    except OSError:
        return None
    private = not stat.S_IMODE(found.st_mode) & 0o077
    mine = not hasattr(os, "getuid") or found.st_uid == os.getuid()
    if stat.S_ISDIR(found.st_mode) and private and mine:
        return folder
    warnings.warn(f"{folder} is open to others and not used as a cache; chmod 700 it", stacklevel=2)
    return None

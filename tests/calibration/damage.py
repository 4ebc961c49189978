"""Calibration files that are well formed and hold a wrong number."""

from calib.session import read_archive, write_archive

KIND = "skin-calibration"
OF_THE_FORMAT = ("format", "format_version", "Conventions", "complete", "seal_sha256")


def damage(path, name, change):
    """Write the calibration at ``path`` anew, with ``change(value)`` in the place of the array ``name``.

    Without this array if that is None.
    """
    whole = read_archive(path, KIND)
    attrs = {k: v for k, v in whole.attrs.items() if k not in OF_THE_FORMAT}
    arrays = {k: (v, whole.units[k], whole.long_names[k]) for k, v in whole.arrays.items()}
    value, *about = arrays.pop(name)
    if (changed := change(value)) is not None:
        arrays[name] = (changed, *about)
    path.unlink()
    write_archive(path, KIND, attrs, arrays)

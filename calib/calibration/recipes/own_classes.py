"""Classes of a user's own that the file of a calibration names, and without which it does not open."""

import jaxeit as je

from ...fitting.curves import CURVES, AbstractCurve
from ...fitting.fields import FIELDS, AbstractField
from ..localisation.locators import AbstractLocator, CentroidLocator


def import_note(curve: AbstractCurve, field: AbstractField | None, locator: AbstractLocator | None) -> str:
    """A note on the classes that whoever opens the file must import; empty if all of them are installed."""
    names = [CURVES.name_of(curve)]
    if field is not None:
        names.append(FIELDS.name_of(field))
        if isinstance(locator, CentroidLocator):
            names.append(je.metrics.ESTIMATORS.name_of(locator.estimator))
    own = [name for name in names if ":" in name]
    if not own:
        return ""
    modules = dict.fromkeys(name.partition(":")[0] for name in own)
    return (
        f"the file opens only where {' and '.join(modules)} has been imported, as it names {' and '.join(own)}; "
        "docs/own-classes.md tells how"
    )

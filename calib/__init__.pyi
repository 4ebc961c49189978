"""Names of `calib` and their modules, from which `__init__.py` imports them on first use."""

from . import (
    batch as batch,
    bench as bench,
    calibration as calibration,
    check as check,
    export as export,
    fitting as fitting,
    learning as learning,
    live as live,
    presses as presses,
    record as record,
    report as report,
    session as session,
    simulators as simulators,
    tanks as tanks,
)
from .batch.parquet_frames import export_training_frames as export_training_frames
from .batch.random_frames import write_training_frames as write_training_frames
from .batch.sessions import calibrate_many as calibrate_many
from .bench import (
    load_bench as load_bench,
    open_training_frames as open_training_frames,
    simulate as simulate,
)
from .calibration import (
    Calibration as Calibration,
    Recipe as Recipe,
    apply as apply,
    calibrate as calibrate,
    evaluate as evaluate,
    force_map as force_map,
    load_calibration as load_calibration,
    recalibrate as recalibrate,
)
from .check import check_session as check_session
from .export import (
    export_c as export_c,
    export_csv as export_csv,
    export_lerobot as export_lerobot,
    export_mcap as export_mcap,
)
from .fitting import (
    Affine as Affine,
    Linear as Linear,
    PadEdge as PadEdge,
    PadEdgeSpline as PadEdgeSpline,
    PowerLaw as PowerLaw,
    fit_curves as fit_curves,
)
from .report.document import write_report as write_report
from .session import (
    Session as Session,
    SessionError as SessionError,
    SessionWriter as SessionWriter,
    open_session as open_session,
)

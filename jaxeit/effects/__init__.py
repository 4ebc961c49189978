"""Effects: departures from the ideal sensor, one small class each, listed in a scene one by one.

An effect that a scene does not list is neither computed nor compiled.  A new effect is one class in the file of its
family, or in a new file, and its import here; `EFFECTS`, scene files and the tests then know the class.

Example:
    import jax
    import jax.numpy as jnp

    import jaxeit as je
    from jaxeit import effects

    jax.config.update("jax_enable_x64", True)

    print(list(effects.EFFECTS))  # the names for scene files
    skin = je.load_skin("testbed")
    scene = je.Scene(
        skin,
        effects=(
            effects.IndentationSpreading(depth=0.01),  # or LoadSpreading
            effects.ProtrusionGrid(pitch=0.006),
            effects.ContactGain(std=0.12, seed=2),
            effects.HomogenisedIslands(),  # or ContactPiezoresistance, or ContinuousCoating
            effects.CoatingNonUniformity(std=0.15, seed=1),
            effects.SheetTemperature(coefficient=1e-3),
            effects.ContactScatter(std=0.5),
            effects.ElectrodeFault(electrode=3, resistance=1e4),
            effects.CommonMode(gain=1e-3),
            effects.PadEdgeDip(depth=0.4),
        ),
    )
    model = je.discretise(scene, je.Fidelity.draft())
    # Pa: 10 N under a tip of 20 mm
    pressure = 10.0 * je.model.load_spread(model, jnp.array([0.06, 0.13]), 0.02)
    # S, 5 K above the temperature of the skin's file
    warm = je.conductivity(model, pressure, temperature=5.0)
    print(f"{1e3 * jnp.abs(je.forward(model, warm) - je.forward(model)).max():.2f} mV")
    print(f"{(je.pad_response(skin, model) @ pressure).max():.0f} Pa")

Example: a recorded pressure
    rest = jnp.zeros(4)  # Pa, gage, in four pads
    held = jnp.where(jnp.arange(400)[:, None] > 50, jnp.array([1000.0, 0, 0, 0]), rest)  # 4 s at 100 Hz
    air = (
        effects.GasLaw(),
        effects.GasRelaxation(time=0.31),
        effects.TpuRelaxation(),
        effects.PadLeak(time=300.0),
        effects.PadTemperature(),
        effects.PadCrosstalk(fraction=0.02),
    )
    readout = (
        effects.SensorError(offset=86.0),
        effects.Noise(std=5.0, stream=effects.StreamKind.PRESSURE),
        effects.Quantisation(step=10.5, stream=effects.StreamKind.PRESSURE),
    )
    inputs = effects.HistoryInputs(
        key=jax.random.key(0),
        interval=jnp.array(0.01),
        temperature=jnp.zeros(400),
        barometer=jnp.zeros(400),
        pattern=jnp.zeros((0, 4), int),
    )
    recorded, state = effects.history(
        air + readout, held, effects.history_start(air + readout, rest), inputs
    )
    print(recorded[-1])  # Pa; the next block of samples starts with `state`

Example: what each readout effect makes of the frames of an untouched skin
    kinds = (
        effects.GainError(std=2e-3),
        effects.BaselineDrift(rate=1e-4),
        effects.PinkNoise(amplitude=1e-6),
        effects.MultiplicativeNoise(std=1e-3),
        effects.MuxSettling(time_constant=5e-7),
        effects.IntermittentElectrode(electrode=7, rate=5.0),
        effects.AdcRanges(bits=14),
    )
    resting = je.forward(model)  # V
    frames = jnp.tile(resting, (400, 1))
    scan = inputs._replace(pattern=model.pattern)
    for kind in kinds:
        series, _ = effects.history((kind,), frames, effects.history_start((kind,), resting), scan)
        print(f"{type(kind).__name__}: {1e6 * jnp.std(series - frames):.1f} uV")

Example: memory of the material, and a load cell
    load = jnp.where(jnp.arange(400)[:, None] < 200, 10.0, 5.0)  # N of one contact
    memory = (effects.Creep(rate=0.05), effects.Hysteresis(loop=0.1))
    felt, _ = effects.history(memory, load, effects.history_start(memory, jnp.zeros(1)), inputs)
    print(felt[199], felt[-1])  # N: more than acts, after a while and on the way down
    cell = effects.LoadCellError(nonlinearity=1e-3)
    print(effects.history((cell,), load, effects.history_start((cell,), jnp.zeros(1)), inputs)[0][0])  # N
"""

from ..registry import Registry
from .base import (
    AbstractClockEffect,
    AbstractCoatEffect,
    AbstractContactEffect,
    AbstractEffect,
    AbstractHistoryEffect,
    AbstractLoadEffect,
    AbstractMemoryEffect,
    AbstractPadEffect,
    AbstractPneumaticEffect,
    AbstractReadoutEffect,
    AbstractScanEffect,
    AbstractSheetEffect,
    AbstractStageEffect,
    AbstractTerminalEffect,
    EffectError,
    chosen,
    fold,
    history,
    history_start,
    keys,
    laid,
    parameter,
)
from .clocks import ClockError, DropOut
from .coating import ContinuousCoating
from .electrical import CommonMode, ContactScatter, ElectrodeFault
from .material import (
    CoatingNonUniformity,
    ContactGain,
    ContactPiezoresistance,
    Creep,
    HomogenisedIslands,
    Hysteresis,
    ProtrusionGrid,
    SheetTemperature,
)
from .mechanics import IndentationSpreading, LoadSpreading, StageError
from .pneumatics import (
    GasLaw,
    GasRelaxation,
    PadCrosstalk,
    PadEdgeDip,
    PadLeak,
    PadTemperature,
    SensorError,
    TpuRelaxation,
)
from .quantities import Circuit, HistoryInputs, Indenter, Packets, Path, Sheet, StreamKind
from .readout import (
    AdcRanges,
    BaselineDrift,
    GainError,
    IntermittentElectrode,
    LoadCellError,
    MultiplicativeNoise,
    MuxSettling,
    Noise,
    PinkNoise,
    Quantisation,
    ScanSkew,
)

EFFECTS = Registry(AbstractEffect, "effect", "jaxeit.effects", spell=str)
"""All effects by the names that scene files use, which are the class names."""

__all__ = [
    "EFFECTS",
    "AbstractClockEffect",
    "AbstractCoatEffect",
    "AbstractContactEffect",
    "AbstractEffect",
    "AbstractHistoryEffect",
    "AbstractLoadEffect",
    "AbstractMemoryEffect",
    "AbstractPadEffect",
    "AbstractPneumaticEffect",
    "AbstractReadoutEffect",
    "AbstractScanEffect",
    "AbstractSheetEffect",
    "AbstractStageEffect",
    "AbstractTerminalEffect",
    "AdcRanges",
    "BaselineDrift",
    "Circuit",
    "ClockError",
    "CoatingNonUniformity",
    "CommonMode",
    "ContactGain",
    "ContactPiezoresistance",
    "ContactScatter",
    "ContinuousCoating",
    "Creep",
    "DropOut",
    "EffectError",
    "ElectrodeFault",
    "GainError",
    "GasLaw",
    "GasRelaxation",
    "HistoryInputs",
    "HomogenisedIslands",
    "Hysteresis",
    "IndentationSpreading",
    "Indenter",
    "IntermittentElectrode",
    "LoadCellError",
    "LoadSpreading",
    "MultiplicativeNoise",
    "MuxSettling",
    "Noise",
    "Packets",
    "PadCrosstalk",
    "PadEdgeDip",
    "PadLeak",
    "PadTemperature",
    "Path",
    "PinkNoise",
    "ProtrusionGrid",
    "Quantisation",
    "ScanSkew",
    "SensorError",
    "Sheet",
    "SheetTemperature",
    "StageError",
    "StreamKind",
    "TpuRelaxation",
    "chosen",
    "fold",
    "history",
    "history_start",
    "keys",
    "laid",
    "parameter",
]

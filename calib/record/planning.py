"""Plan a recording from a skin and the URLs of its streams."""

import time
from collections.abc import Mapping
from datetime import UTC, datetime
from types import MappingProxyType
from typing import TYPE_CHECKING
from uuid import uuid4

from ..session.mixing import terms_of_mixing
from .plan import PlanError, RecordingPlan
from .sources import Source, source_from_url

if TYPE_CHECKING:
    import jaxeit as je

NO_CHANNELS: Mapping[str, int] = MappingProxyType({})
CHANNELS = {"force": 1, "stage": 3, "temperature": 1, "barometer": 1}  # of streams that do not depend on the skin


def plan_recording(
    urls: Mapping[str, str], skin: "je.Skin | None", title: str = "", *, channels: Mapping[str, int] = NO_CHANNELS
) -> tuple[RecordingPlan, list[Source]]:
    """Plan what to record, and from which sources.

    Args:
        urls: by stream name (a key of `STREAM_KINDS`); see `sources` for their form.
        skin: gives the protocol of the EIT stream and the number of pads; None if neither is recorded.
        channels: numbers of values of streams, by name, where they are known otherwise.

    Raises:
        PlanError: without any stream, or if a stream needs the skin.
        SourceError: for URLs that name no source.
    """
    sources = [
        source_from_url(name, url, channels.get(name) or _channels(name, url, skin)) for name, url in urls.items()
    ]
    eit = skin.protocol if skin is not None and "eit" in urls else None
    plan = RecordingPlan(
        streams=tuple(s.plan for s in sources),
        epoch=datetime.now(UTC).isoformat(),
        host_epoch=time.monotonic_ns(),
        session_id=str(uuid4()),
        title=title,
        skin_name=skin.name if skin is not None else "",
        skin_toml=skin.toml if skin is not None else "",
        pattern=None if eit is None else tuple(tuple(map(int, row)) for row in eit.pattern),
        mixing=None if eit is None else _terms(eit),
        current=None if eit is None else float(eit.current),
        frequency=None if eit is None else float(eit.frequency),
        offset=None if eit is None else tuple(map(float, eit.reading_offsets)),
    )
    return plan, sources


def _terms(protocol: "je.Protocol") -> tuple[tuple[int | float, ...], ...] | None:
    """Reading, row of the pattern and share of each term, where readings are sums of rows."""
    if protocol.mixing is None:
        return None
    return tuple(zip(*(part.tolist() for part in terms_of_mixing(protocol.mixing)), strict=True))


def _channels(name: str, url: str, skin: "je.Skin | None") -> int:
    if name in CHANNELS:
        return CHANNELS[name]
    if skin is not None:
        return skin.protocol.readings if name == "eit" else max(len(skin.pads), 1)
    if name == "eit":
        raise PlanError("eit: the order of its readings is not known; name the skin: --skin testbed, or a TOML file")
    if "channels=" not in url:
        raise PlanError(f"{name}: its number of values is not known; name the skin, or add channels= to {url}")
    return 1

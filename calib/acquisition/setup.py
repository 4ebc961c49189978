"""A recording planned from a skin and the URLs of its streams."""

import time
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import TYPE_CHECKING
from uuid import uuid4

from .plan import Plan, PlanError
from .sources import Source, source

if TYPE_CHECKING:
    import jaxeit as je

_CHANNELS = {"force": 1, "stage": 3, "temperature": 1, "barometer": 1}


def prepare(urls: Mapping[str, str], skin: "je.Skin | None", title: str = "") -> tuple[Plan, list[Source]]:
    """What to record, and from where.

    Args:
        urls: by stream name (a key of `KINDS`), see `sources`.
        skin: says the protocol of the EIT stream and the number of pads; not needed without them.

    Raises:
        PlanError: without any stream, or without a skin where one is needed.
        SourceError: for URLs that name no source.
    """
    sources = [source(name, url, _channels(name, url, skin)) for name, url in urls.items()]
    eit = skin.protocol if skin is not None and "eit" in urls else None
    plan = Plan(
        streams=tuple(s.plan for s in sources),
        epoch=datetime.now(UTC).isoformat(),
        host_epoch=time.monotonic_ns(),
        session_id=str(uuid4()),
        title=title,
        skin_name=skin.name if skin is not None else "",
        skin_toml=skin.toml if skin is not None else "",
        pattern=None if eit is None else tuple(tuple(map(int, row)) for row in eit.pattern),
        current=None if eit is None else float(eit.current),
        frequency=None if eit is None else float(eit.frequency),
        offset=None if eit is None else tuple(n * float(eit.reading_time) for n in range(eit.readings)),
    )
    return plan, sources


def _channels(name: str, url: str, skin: "je.Skin | None") -> int:
    if name in _CHANNELS:
        return _CHANNELS[name]
    if skin is not None:
        return skin.protocol.readings if name == "eit" else max(len(skin.pads), 1)
    if name == "eit":
        raise PlanError("eit: in which order are its readings measured? name the skin: --skin testbed, or a TOML file")
    if "channels=" not in url:
        raise PlanError(f"{name}: how many values has a frame? name the skin, or add channels= to {url}")
    return 1

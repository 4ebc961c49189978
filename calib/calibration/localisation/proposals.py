"""Which network proposes what touches a skin."""

from collections.abc import Callable

import jaxeit as je
from jaxeit.contacts import LoadSettings, Proposal, shipped_proposal

# A proposal, one that depends on the skin (None: none fits it), or None: none is wanted.
ProposalChoice = Proposal | Callable[[je.Skin], Proposal | None] | None


def chosen_proposal(
    choice: ProposalChoice, skin: je.Skin, tell: Callable[[str], object], settings: LoadSettings | None = None
) -> Proposal | None:
    """The proposal to use for a skin.

    Args:
        choice: see `ProposalChoice`.
        tell: called with a line where a proposal is wanted and none fits the skin.
        settings: of the loads; default: the usual ones, on which the shipped proposals were trained.

    Raises:
        InverseError: if the proposal was trained for another skin.
    """
    if settings is not None and choice is shipped_proposal:
        return None
    found = choice if choice is None or isinstance(choice, Proposal) else choice(skin)
    if found is not None:
        found.require_skin(skin)
    elif choice is not None:
        tell(f"note: no network is shipped that proposes what touches the skin {skin.name}; {_advice(skin)}")
    return found


def _advice(skin: je.Skin) -> str:
    if skin.protocol.mixing is not None:
        return "none can be trained for its scan, whose readings are sums over pairs of electrodes"
    return "train one with `jaxeit train SKIN -o PROPOSAL.npz`, and give it as --proposal PROPOSAL.npz"

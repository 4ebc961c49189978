"""Where the skin is touched, and by how many contacts.

Example:
    import jax
    import jax.numpy as jnp
    import numpy as np

    import jaxeit as je

    jax.config.update("jax_enable_x64", True)

    skin = je.load_skin("testbed")
    model = je.discretise(je.Scene(skin), je.Fidelity.draft())
    v0 = je.forward(model)  # V
    noise = jnp.full(len(v0), 1e-4 * jnp.abs(v0).max())  # V, of each reading
    places = jnp.array([[0.05, 0.13], [0.15, 0.06]])  # m
    bumps = sum(
        jnp.exp(-jnp.sum((model.centroids - place) ** 2, 1) / (2 * 0.01**2)) for place in places
    )
    dv = je.forward(model, model.background * (1 + 0.4 * bumps)) - v0

    finder = je.prepare_contacts(model, je.contacts.ContactSettings(most=2, columns=21), noise=noise)
    found = finder(dv)  # or equinox.filter_jit(finder)(dv), or in a function under jax.jit or jax.vmap
    for place, width, present in zip(found.position, found.width, found.present, strict=True):
        if present:
            print(f"at {1e3 * place[0]:.1f}, {1e3 * place[1]:.1f} mm, {1e3 * width:.1f} mm wide")
    print("the strongest one at", je.contacts.strongest(found))  # m
    print(f"contacts of less than {je.contacts.MIN_RELATIVE_STRENGTH:.0%} of its strength do not count")
    print(je.contacts.ContactResult(int(found.result[0])).name)
    je.plot.show_contacts(found, je.plot.show_skin(skin)).figure.savefig("contacts.png")
"""

from .loads import (
    AbstractGain,
    ForceLaw,
    LoadFitter,
    LoadKind,
    Loads,
    LoadSettings,
    LoadShape,
    Proposal,
    Proposed,
    learn_loads,
    load_proposal,
    prepare_loads,
    shipped_proposal,
)
from .preparation import prepare_contacts
from .refinement import refine_contacts
from .regions import RegionError, Regions, find_regions
from .result import ContactResult, Contacts, strongest
from .search import MIN_RELATIVE_STRENGTH, ContactFinder
from .settings import ContactSettings

__all__ = [
    "MIN_RELATIVE_STRENGTH",
    "AbstractGain",
    "ContactFinder",
    "ContactResult",
    "ContactSettings",
    "Contacts",
    "ForceLaw",
    "LoadFitter",
    "LoadKind",
    "LoadSettings",
    "LoadShape",
    "Loads",
    "Proposal",
    "Proposed",
    "RegionError",
    "Regions",
    "find_regions",
    "learn_loads",
    "load_proposal",
    "prepare_contacts",
    "prepare_loads",
    "refine_contacts",
    "shipped_proposal",
    "strongest",
]

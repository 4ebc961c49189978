"""Where the skin is touched, and by how many contacts."""

from .loads import (
    LoadFitter,
    LoadKind,
    Loads,
    LoadSettings,
    LoadShape,
    Proposal,
    Proposed,
    load_proposal,
    prepare_loads,
    shipped_proposal,
)
from .preparation import prepare_contacts
from .refinement import refine_contacts
from .regions import RegionError, Regions, find_regions
from .result import ContactResult, Contacts, strongest
from .search import ContactFinder
from .settings import ContactSettings

__all__ = [
    "ContactFinder",
    "ContactResult",
    "ContactSettings",
    "Contacts",
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
    "load_proposal",
    "prepare_contacts",
    "prepare_loads",
    "refine_contacts",
    "shipped_proposal",
    "strongest",
]

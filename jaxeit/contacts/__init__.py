"""Where the skin is touched, and by how many contacts."""

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
    "RegionError",
    "Regions",
    "find_regions",
    "prepare_contacts",
    "refine_contacts",
    "strongest",
]

"""Contacts from perfect to none: no digit may be lost, which only exact arithmetic can tell."""

import numpy as np
import pytest

import jaxeit as je

from ..hard_sheet import by_inverse, by_schur_and_pinv, exact, found, sheet_model, worst
from ..oracles.disc import disc_resistance

EVEN = [(10.0**k,) * 4 for k in (-12, -9, -6, -3, 0, 3, 6, 8)]
MIXED = [(1e-12, 1e8, 1e-12, 1e8), (1e8, 1e-12, 1e-6, 1.0), (1e-12, 1e-12, 1e8, 1e8)]
SIGMA = np.random.default_rng(0).integers(1, 33, 64) / 16.0


@pytest.mark.parametrize("contacts", EVEN + MIXED, ids=str)
@pytest.mark.parametrize("solver", [je.linalg.Dense(), je.linalg.NestedDissection()], ids=["dense", "dissection"])
def test_no_digit_is_lost_to_the_contacts(contacts, solver, hard):
    """Drive, three-terminal and four-terminal readings in both precisions against exact arithmetic."""
    right = exact(SIGMA, contacts)
    double, single = (worst(found(sheet_model(solver, d), SIGMA, contacts), right) for d in ("float64", "float32"))
    assert double < 1e-12
    assert single < 3e-5
    hard(
        "contact resistance",
        "1e-12 to 1e8 Ω m (rim) and Ω m² (patch), even and mixed, of each reading",
        float64=double,
        float32=single,
        naive=worst(by_schur_and_pinv(SIGMA, contacts), right),
        beyond="zero is a perfect contact; a value that is negative or not finite: an error that names it",
    )


def test_the_textbook_loses_them():
    """In the potentials themselves the strong contacts are lost; by subtraction and pseudo-inverse the weak ones."""

    def error(way, contact, dtype=float):
        return worst(way(SIGMA, (contact,) * 4, dtype), exact(SIGMA, (contact,) * 4))

    assert error(by_inverse, 1e-12) > 1e-4
    assert error(by_inverse, 1e-6, np.float32) > 0.1
    for contact in (1e3, 1e6, 1e8):
        assert error(by_schur_and_pinv, contact) > 1e-2


def test_a_disc_of_any_contact_follows_its_limits():
    """I0(x) / I1(x) = 2 / x + x / 4 - x^3 / 96 for weak contacts, 1 + 1 / 2x + 3 / 8x^2 for strong ones."""
    radius, sheet = 0.003, 100.0
    for contact in 10.0 ** np.arange(2, 9):
        weak = contact / (np.pi * radius**2) + sheet / (8 * np.pi) * (1 - sheet * radius**2 / contact / 24)
        assert disc_resistance(radius, contact, sheet) == pytest.approx(weak, rel=1e-14)
    for contact in 10.0 ** np.arange(-18, -11):
        shorter = np.sqrt(contact / sheet) / radius
        strong = sheet / (2 * np.pi) * (shorter + shorter**2 / 2 + 3 * shorter**3 / 8)
        assert disc_resistance(radius, contact, sheet) == pytest.approx(strong, rel=1e-12)

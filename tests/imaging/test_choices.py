"""Choices of an image that do not go together are refused when they are made, not after the recordings are read."""

from typing import ClassVar

import numpy as np
import pytest

import jaxeit as je
from calib.cli import main
from jaxeit.imaging import InverseError

NEEDS_NOISE = [je.imaging.Discrepancy(), je.imaging.PriorDeviation(1e-4)]
NOT_DIAGONAL = [je.Laplace(), je.GaussianSmooth()]


@pytest.mark.parametrize("prior", NOT_DIAGONAL)
def test_a_method_for_diagonal_priors_refuses_others(model, prior):
    said = f"SparseBayes needs a diagonal prior, which {type(prior).__name__} is not"
    with pytest.raises(InverseError, match=said):
        je.Imaging(method=je.SparseBayes(), prior=prior)
    with pytest.raises(InverseError, match=said):
        je.prepare(model, prior, je.SparseBayes(), je.Pixels(4))
    je.Imaging(method=je.SparseBayes(), prior=je.Tikhonov())


class OwnPrior(je.AbstractPrior):
    """Its R is diagonal, which only its precision tells."""

    def precision(self, jacobian, picture, at=None):
        return je.imaging.Diagonal(picture.areas)


class DeclaredPrior(OwnPrior):
    """One that says so."""

    diagonal: ClassVar[bool | None] = False


def test_an_own_prior_may_leave_its_form_open():
    assert je.Imaging(method=je.SparseBayes(), prior=OwnPrior())
    with pytest.raises(InverseError, match="which DeclaredPrior is not"):
        je.Imaging(method=je.SparseBayes(), prior=DeclaredPrior())


@pytest.mark.parametrize("weight", NEEDS_NOISE)
def test_a_hyperparameter_that_compares_with_noise_needs_its_size(model, weight):
    said = f"the hyperparameter {type(weight).__name__} compares with the noise, whose size is not known"
    with pytest.raises(InverseError, match=said):
        je.Imaging(hyperparameter=weight)
    with pytest.raises(InverseError, match=said):
        je.prepare(model, basis=je.Pixels(4), hyperparameter=weight)
    for noise in (je.imaging.MeasuredNoise(), je.imaging.CorrelatedNoise()):
        assert je.Imaging(hyperparameter=weight, noise=noise)


def test_no_hyperparameter_is_an_error_of_the_room(model):
    """Callers that catch what no reconstruction can be made of catch it too."""
    assert issubclass(je.imaging.HyperparameterError, InverseError)
    noise = np.full(model.readings, 1e-6)
    with pytest.raises(InverseError, match="PriorDeviation has no deviation"):
        je.prepare(model, basis=je.Pixels(4), noise=noise, hyperparameter=je.imaging.PriorDeviation())


@pytest.mark.parametrize(
    "given",
    [
        ["--hyperparameter", "discrepancy"],
        ["--hyperparameter", "prior-deviation:deviation=1e-4"],
        ["--noise", "measured"],
    ],
)
def test_bench_names_what_needs_noise(given, capsys):
    assert main(["bench", "--smoke", *given]) == 2
    assert "the study's readings have no noise to be measured" in capsys.readouterr().err


def test_what_an_imaging_is_for_stands_beside_the_numbers(model):
    recon = je.Imaging(je.Pixels(4)).prepare(model, provenance={"bench": "third floor"})
    assert recon.provenance["bench"] == "third floor"

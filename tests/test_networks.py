"""The networks: published sizes, any camera, and what they start from."""

import pytest
import torch

from random_camera import smooth_camera
from squilla.reconstruction.models import MODELS, model_class
from squilla.reconstruction.networks import CNN, MLP, ResCNN, ReSpecNN, UNet

# Thesis, tables 5.1 and 5.2 with the layers worked out; BEST camera paper.
WEIGHTS = {CNN: 1030466, ResCNN: 3566387, UNet: 18504264, ReSpecNN: 4066562, MLP: 1146251}


@pytest.mark.parametrize("kind", WEIGHTS)
def test_published_number_of_weights(kind):
    model = kind(smooth_camera(filters=36, bands=251))
    assert sum(weight.numel() for weight in model.parameters()) == WEIGHTS[kind]


@pytest.mark.parametrize("kind", WEIGHTS)
@pytest.mark.parametrize(("filters", "bands"), [(1, 16), (9, 31), (25, 100)])
def test_any_number_of_filters_and_bands(kind, filters, bands):
    model = kind(smooth_camera(filters=filters, bands=bands))
    assert model.estimate(torch.rand(3, filters), None).shape == (3, bands)


@pytest.mark.parametrize("kind", WEIGHTS)
def test_every_weight_is_used(kind):
    model = kind(smooth_camera(filters=9, bands=32)).train()
    torch.manual_seed(0)
    model.estimate(torch.rand(8, 9), None).square().sum().backward()
    assert all(weight.grad is not None for weight in model.parameters())


def test_rescnn_without_weights_is_its_linear_estimate():
    model = ResCNN(smooth_camera(filters=9, bands=32))
    torch.nn.init.zeros_(model.gather.weight)
    torch.nn.init.zeros_(model.gather.bias)
    y = torch.rand(5, 9)
    torch.testing.assert_close(model.estimate(y, None), y @ model.lift)


def test_rescnns_linear_estimate_measures_as_the_measurement():
    """Its lift is R' (R R' + c I)^-1: damped least squares, exact where c is small against R R'."""
    camera = smooth_camera(filters=4, bands=64)
    model = ResCNN(camera)
    flat = camera.project(torch.ones(1, 64))
    again = camera.project(flat / flat.max() @ model.lift)
    torch.testing.assert_close(again, flat, rtol=0.1, atol=0)


def test_the_registry_names_every_class():
    for name in MODELS:
        assert model_class(name).name == name

"""Any response matrix of one's own: spectra from measurements, without a microlens camera."""

import torch

import squilla as sq
from squilla.optics.filters import StencilRecipe
from squilla.priors import natural_spectra
from squilla.reconstruction.linear import Ridge
from squilla.spectra import grid

wavelength = grid(500, 750, 1)
R = StencilRecipe().draw(3).transmittance(wavelength).numpy()  # (M, K); yours here
calibration = sq.Calibration.from_sensitivity(R, wavelength)

generator = torch.Generator().manual_seed(0)
x = natural_spectra(1000, wavelength, generator=generator)
y = calibration.project(x)
y = y + 0.01 * y.max() * torch.randn(y.shape, generator=generator)

ridge = Ridge(calibration)  # knows the noise of each measurement if it is told
network = sq.train("mlp", calibration, noise=(25, 35), epochs=20, learning_rate=1e-3)
with torch.inference_mode():
    for model in (ridge, network):
        print(f"{model.name}: MSE {float((model(y, snr=30.0) - x).square().mean()):.5f}")

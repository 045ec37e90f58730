"""The networks of the thesis and the fully connected network of the BEST camera.

The layers of the thesis' networks are not published in full; these have exactly the published
numbers of weights and are therefore named parameter-matched reconstructions of them. Every network
maps y / max(y), (N, M), to a spectrum whose maximum is 1, (N, K), for any M and K; the numbers of
weights in the text are for 36 filters and 251 bands. Convolutions run along the wavelengths, with
kernel 3, padding 1, bias and ReLU, unless said.
"""

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d, linear, max_pool1d, pad, relu

from squilla.calibration.calibration import Calibration
from squilla.reconstruction.reconstructor import Reconstructor


class MLP(Reconstructor):
    """Fully connected, M-500-500-500-500-500-K, LeakyReLU 0.01; 1 146 251 weights.

    Source: Zhang et al., BEST camera (layers as published).
    """

    name = "mlp"
    trained = True

    def __init__(self, calibration: Calibration):
        super().__init__(calibration)
        widths = [calibration.filters, 500, 500, 500, 500, 500]
        hidden = [(nn.Linear(a, b), nn.LeakyReLU(0.01)) for a, b in pairwise(widths)]
        last = nn.Linear(500, len(calibration.wavelength))
        self.layers = nn.Sequential(*(layer for pair in hidden for layer in pair), last)

    def estimate(self, y: Tensor, angle: Tensor | None = None, snr: Tensor | None = None):
        return self.layers(y)


class CNN(Reconstructor):
    """Dense M-K; Conv 1-64, pool 2; Conv 64-64, pool 2; Conv 64-64; dense to K; 1 030 466 weights.

    Source: thesis, tables 5.1 and 5.2; a parameter-matched reconstruction.
    """

    name = "cnn"
    trained = True
    piece = 256

    def __init__(self, calibration: Calibration):
        super().__init__(calibration)
        bands = len(calibration.wavelength)
        self.spread = nn.Linear(calibration.filters, bands)
        self.first = _convolution(1, 64)
        self.second = _convolution(64, 64)
        self.third = _convolution(64, 64)
        self.gather = nn.Linear(64 * (bands // 4), bands)

    def estimate(self, y: Tensor, angle: Tensor | None = None, snr: Tensor | None = None):
        x = self.spread(y)[:, None]
        x = max_pool1d(relu(self.first(x)), 2)
        x = max_pool1d(relu(self.second(x)), 2)
        return self.gather(relu(self.third(x)).flatten(1))


class ResCNN(Reconstructor):
    """A linear estimate corrected by Conv 1-56, 4 x Conv 56-56, dense to K; 3 566 387 weights.

    x = x0 + F(x0) with the fixed x0 = R' (R R' + c I)^-1 y. R is scaled here so that a flat
    spectrum measures as a maximum of 1, and c is a hundredth of the mean eigenvalue of R R': noise
    of 20 dB.

    Source: thesis, tables 5.1 and 5.2; a parameter-matched reconstruction.
    """

    name = "rescnn"
    trained = True
    piece = 256
    lift: Tensor

    def __init__(self, calibration: Calibration):
        super().__init__(calibration)
        bands = len(calibration.wavelength)
        response = calibration.mean_sensitivity.double()
        response = response / response.sum(-1).max()
        gram = response @ response.T
        damping = 0.01 * gram.diagonal().mean() * torch.eye(len(gram), dtype=torch.float64)
        self.register_buffer("lift", torch.linalg.solve(gram + damping, response).float())
        self.layers = nn.ModuleList(
            _convolution(a, b) for a, b in pairwise([1, 56, 56, 56, 56, 56])
        )
        self.gather = nn.Linear(56 * bands, bands)

    def estimate(self, y: Tensor, angle: Tensor | None = None, snr: Tensor | None = None):
        start = y @ self.lift
        x = start[:, None]
        for layer in self.layers:
            x = relu(layer(x))
        return start + self.gather(x.flatten(1))


class UNet(Reconstructor):
    """Dense M-K, then a residual U-Net of four levels along the wavelengths; 18 504 264 weights.

    Blocks 1-64-128-256-512 and 1024 at the bottom, max-pooling in between; up again by transposed
    convolutions of kernel 2 with skips; at last a convolution 64-1 of kernel 1. The wavelengths
    are padded to a multiple of 16 and cropped.

    Source: thesis, tables 5.1 and 5.2; a parameter-matched reconstruction.
    """

    name = "unet"
    trained = True
    piece = 128

    def __init__(self, calibration: Calibration):
        super().__init__(calibration)
        bands = len(calibration.wavelength)
        widths = [1, 64, 128, 256, 512, 1024]
        self.spread = nn.Linear(calibration.filters, bands)
        self.padding = -bands % 16
        self.down = nn.ModuleList(ResidualBlock(a, b) for a, b in pairwise(widths))
        upward = list(pairwise(widths[:0:-1]))
        self.up = nn.ModuleList(nn.ConvTranspose1d(a, b, 2, stride=2) for a, b in upward)
        self.merge = nn.ModuleList(ResidualBlock(a, b) for a, b in upward)
        self.last = nn.Conv1d(64, 1, 1)
        self.eval()

    def estimate(self, y: Tensor, angle: Tensor | None = None, snr: Tensor | None = None):
        x = self.spread(y)
        bands = x.shape[-1]
        x = pad(x, (0, self.padding))[:, None]
        skips = []
        for block in self.down[:-1]:
            x = block(x)
            skips.append(x)
            x = max_pool1d(x, 2)
        x = self.down[-1](x)
        for up, merge in zip(self.up, self.merge, strict=True):
            x = merge(torch.cat([skips.pop(), up(x)], dim=1))
        return self.last(x)[:, 0, :bands]


class ReSpecNN(Reconstructor):
    """Dense M-K; Conv 1-64; 2 x Conv 64-64; dense to K; sigmoid; 4 066 562 weights.

    Source: thesis, tables 5.1 and 5.2; a parameter-matched reconstruction.
    """

    name = "respecnn"
    trained = True
    piece = 256

    def __init__(self, calibration: Calibration):
        super().__init__(calibration)
        bands = len(calibration.wavelength)
        self.spread = nn.Linear(calibration.filters, bands)
        self.layers = nn.ModuleList(_convolution(a, b) for a, b in pairwise([1, 64, 64, 64]))
        self.gather = nn.Linear(64 * bands, bands)

    def estimate(self, y: Tensor, angle: Tensor | None = None, snr: Tensor | None = None):
        x = self.spread(y)[:, None]
        for layer in self.layers:
            x = relu(layer(x))
        return torch.sigmoid(self.gather(x.flatten(1)))

    def for_engines(self) -> nn.Module:
        return _Picture(self)


class _Picture(nn.Module):
    """`ReSpecNN` with the pixels as rows of one picture, and channels last in the dense layer.

    A few large convolutions take an engine less time than many small ones.
    """

    def __init__(self, network: ReSpecNN):
        super().__init__()
        self.network = network
        weight = network.gather.weight.detach()
        self.gather = weight.unflatten(1, (-1, len(weight))).mT.flatten(1).contiguous()

    def forward(self, y: Tensor) -> Tensor:
        x = self.network.spread(y)[None, None]
        for layer in self.network.layers:
            assert isinstance(layer, nn.Conv1d)
            x = relu(conv2d(x, layer.weight[:, :, None], layer.bias, padding=(0, 1)))
        x = x.permute(0, 2, 3, 1)[0].flatten(1)
        return torch.sigmoid(linear(x, self.gather, self.network.gather.bias))


class ResidualBlock(nn.Module):
    """Two kernel-5 convolutions with batch norm, and a shortcut of kernel 1 around them."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.first = nn.Conv1d(inputs, outputs, 5, padding=2)
        self.first_norm = nn.BatchNorm1d(outputs)
        self.second = nn.Conv1d(outputs, outputs, 5, padding=2)
        self.second_norm = nn.BatchNorm1d(outputs)
        self.shortcut = nn.Conv1d(inputs, outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        inner = relu(self.first_norm(self.first(x)))
        return relu(self.second_norm(self.second(inner)) + self.shortcut(x))


def _convolution(inputs: int, outputs: int) -> nn.Conv1d:
    return nn.Conv1d(inputs, outputs, 3, padding=1)

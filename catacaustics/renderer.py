"""The neural renderer: per-pixel MLPs that decode splatted features. No convolutions: they flicker and hide errors."""

import torch
from torch import Tensor, nn

from catacaustics.renderer_native import decode
from catacaustics.shapes import Float

FEATURES = 6
"""Features a point carries (paper section 5)."""


class _ResidualBlock(nn.Module):
    """x + scale (W2 relu(W1 x + b1) + b2) with FixUp initialisation (Zhang et al. 2019): W2 starts at zero."""

    def __init__(self, width: int, blocks: int):
        super().__init__()
        self.first = nn.Linear(width, width)
        self.second = nn.Linear(width, width)
        self.scale = nn.Parameter(torch.ones(()))
        nn.init.kaiming_normal_(self.first.weight, nonlinearity="relu")
        # FixUp: blocks of m = 2 layers scale their first weights by L^(-1 / (2 m - 2)).
        self.first.weight.data *= blocks**-0.5
        nn.init.zeros_(self.first.bias)
        nn.init.zeros_(self.second.weight)
        nn.init.zeros_(self.second.bias)

    def forward(self, x: Tensor) -> Tensor:
        # In place, and the scale in the small matrix: these layers are bound by memory traffic, not by arithmetic.
        hidden = self.first(x).relu_()
        return torch.addmm(x, hidden, (self.scale * self.second.weight).T).add_(self.scale * self.second.bias)


class ResidualMLP(nn.Module):
    """`layers` linear layers of equal width with ReLU and a residual connection every 2 (layers odd: 1 + 2 blocks)."""

    def __init__(self, inputs: int, width: int = 32, layers: int = 9):
        super().__init__()
        blocks = (layers - 1) // 2
        self.input = nn.Linear(inputs, width)
        self.blocks = nn.Sequential(*(_ResidualBlock(width, blocks) for _ in range(blocks)))

    def forward(self, x: Tensor) -> Tensor:
        x = self.input(x).relu_()
        return self.blocks(x).relu_() if len(self.blocks) else x


class NeuralRenderer(nn.Module):
    """Two encoders (primary features and view direction; reflection features) and a decoder on their concatenation.

    The first three features of each cloud are colours: their sum is the image, and the network, whose last layer starts
    at zero, adds what colours alone cannot show. So training starts from the coloured clouds, not from noise.
    """

    def __init__(self, width: int = 32, layers: int = 9):
        super().__init__()
        self.primary_encoder = ResidualMLP(FEATURES + 3, width, layers)
        self.reflection_encoder = ResidualMLP(FEATURES, width, layers)
        self.decoder = ResidualMLP(2 * width, width, layers)
        self.head = nn.Linear(width, 3)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def forward(
        self,
        primary: Float[Tensor, "height width 6"],
        reflection: Float[Tensor, "height width 6"],
        directions: Float[Tensor, "height width 3"],
    ) -> Float[Tensor, "height width 3"]:
        """Decode features, already weighted by 1 - rho and rho, and unit view directions to RGB (not clamped)."""
        native = decode(primary, reflection, directions, list(self.parameters()))
        if native is not None:
            return native
        # A list of pixels: in-place steps on views of it would be copied by autograd.
        seen = torch.cat([primary, directions], -1).flatten(0, 1)
        code = torch.cat([self.primary_encoder(seen), self.reflection_encoder(reflection.flatten(0, 1))], -1)
        return primary[..., :3] + reflection[..., :3] + self.head(self.decoder(code)).view_as(directions)

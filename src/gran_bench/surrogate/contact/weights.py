"""What the solver of a contact network takes of the model: its weights and its sizes."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class ContactWeights:
    """K iterations' weights, for the two kinds of contact, and the sizes that go with them.

    Attributes:
        hidden_weight, hidden_bias: ``(K, 2, hidden, inputs)`` and ``(K, 2, hidden)``.
        output_weight, output_bias: ``(K, 2, outputs, hidden)`` and ``(K, 2, outputs)``.
        stiffness: ``(K, 2)`` κ, share of an overlap that is pushed out.
        spin_share: ``(K, 2)`` σ.
        mix_weight, mix_bias: ``(K, channels + 1, channels)`` and ``(K, channels + 1)``.
        diameter: mm.
        fades: of a pair and of a wall: the gap at which an answer has faded to nothing, and the width over which it
            fades, mm.
        memory: whether contacts carry springs.
        instantaneous: whether the velocity is the one at the frame's end.
    """

    hidden_weight: Tensor
    hidden_bias: Tensor
    output_weight: Tensor
    output_bias: Tensor
    stiffness: Tensor
    spin_share: Tensor
    mix_weight: Tensor
    mix_bias: Tensor
    diameter: float
    fades: tuple[tuple[float, float], tuple[float, float]]
    memory: bool
    instantaneous: bool

    @property
    def channels(self) -> int:
        """How many numbers a particle hands from one iteration to the next."""
        return self.mix_weight.shape[2]

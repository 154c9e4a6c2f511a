"""Accelerations of a particle and a wall branch over a static boundary: a relative of the founding article's CCNN."""

from gran_bench.config import BoundaryConfig, XuShen2022Config
from gran_bench.config.choices import check_static
from gran_bench.scene import Scene
from gran_bench.surrogate.convolution.ccnn import ContinuousConvolutionNetwork


class XuShen2022Network(ContinuousConvolutionNetwork):
    """Accelerations first, a = a_pp + a_pw of two branches, then Newton's law.

    v* = vⁿ + g Δt;  a = a_pp + a_pw at (x*, v*);  vⁿ⁺¹ = v* + a Δt;  x as ``update`` says (`NewtonSurrogate`).

    *Particle branch.* Layer 1 joins a convolution over the neighbours' (v*, 1) and a linear map of v*. *Wall branch.*
    Layer 1 joins a linear map of v* and a convolution over the points of the walls, with their normals; its later
    layers convolve over the particles. The founding article's CCNN is this network with a second wall convolution, of
    the wall's velocities; so what both have is one code (`ContinuousConvolutionNetwork`).

    *A static boundary* has positions and normals and no velocity. In a drum that turns, its points stay where they are,
    and a wall that drags particles along looks like one that rests: only its shape can push.

    *Free flight* is exact: each branch fades to zero where its nearest neighbour, or the wall, reaches the edge of R,
    and Newton's law does the rest.

    The article says acceleration, Newton's law, branches apart, static boundary, and packs particles. What follows is
    chosen here, most of it a key of the model: widths, layers, R, window and lattice (as of Ummenhofer et al. 2020),
    the constant input, the residual, the unit of output, ``update``, gravity apart from the network, and the fading.

    Args:
        config: widths, kernel, R, update.
        boundary: ``spheres`` without velocity, or ``none``.
        scene: for the particles' diameter, and whether there are walls at all.

    Raises:
        ConfigError: walls with a velocity, or an impossible size.

    Source: Xu & Shen (2022), as the founding article describes it.
    """

    def __init__(self, config: XuShen2022Config, boundary: BoundaryConfig, scene: Scene) -> None:
        check_static(config, boundary)
        super().__init__(config, boundary, scene)

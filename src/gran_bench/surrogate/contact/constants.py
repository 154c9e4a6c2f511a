"""The numbers of the contact network that no weight holds, for the readable solver and the compiled one alike."""

from gran_bench.config.consistency import FUSED_SIZES

# The unit of length inside the contact network is 1/50 of a diameter: 1 units where d is 50 units.
DIAMETER = 50.0  # units
SKIN = 0.2  # of a diameter, beyond their reach, that pairs are listed for frames to come
PAIR, WALL = 0, 1  # kinds of contact, each with its own weights

# What a perceptron sees.
RAMP_NODES = (-4.0, -1.5, -0.6, -0.2, 0.2, 0.6, 1.5, 4.0, 10.0)  # units; the gap's ramps run from node to node
INPUT_CLAMP = 8.0  # units a frame; a perceptron never sees more
INPUT_SCALE = 0.3
CHANNEL_CLAMP = 5.0

# What its answer does.
WALL_FADE = 0.5  # of the wall's reach
VISCOUS_SHARE = 0.3  # of c in τ = slip (b/s + 0.3 c)
SMALLEST_SLIP_SQUARED = 1.0e-4  # units², keeps the direction of slip differentiable at rest
SPIN_RESPONSE = 1.25  # ½ m r²/I of a solid sphere: surface speed that a unit of tangential displacement brings
SPRING_CAP = 0.40  # of the overlap; a longer spring has slid

HIDDEN, CHANNELS = FUSED_SIZES  # of the fused kernel

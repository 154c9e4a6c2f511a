"""How far the damping looks ahead.

A step knows velocities of its middle. The damping of a contact counts in what the velocity still gains until the step's
end, times max(0, 1 − PREDICTION_FADE γ Δt / m*), where γ is the drag of the contact.
"""

# A predicted velocity halves the step up to which damping is stable. So the prediction fades out as γΔt/m* nears a
# third, which three and more contacts of a sphere in a bed make one.
PREDICTION_FADE = 3.0

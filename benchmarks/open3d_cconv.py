"""Open3D's layer in a process of its own, for `cconv.py`: reads a problem, then a word a line, and answers seconds.

Run by an interpreter that has torch and open3d; gran-bench need not be there.
"""

import sys
import time

import numpy as np
import torch


def main(problem: str, answer: str) -> None:
    """Builds the layer, keeps its output and gradients in ``answer``, then times it as often as it is asked to."""
    import open3d.ml.torch as ml3d

    torch.set_num_threads(1)
    given = {name: torch.from_numpy(values) for name, values in np.load(problem).items()}
    kernel, features = given["kernel"], given["features"].requires_grad_()  # kernel: (z, y, x, in, out)
    layer = ml3d.layers.ContinuousConv(
        kernel.shape[3],
        kernel.shape[4],
        list(kernel.shape[:3]),
        use_bias=False,
        align_corners=True,
        coordinate_mapping="ball_to_cube_volume_preserving",
        interpolation="linear",
        normalize=False,
    )
    with torch.no_grad():
        layer.kernel.copy_(kernel)
    neighbors = {f"user_neighbors_{name}": given[name] for name in ("index", "row_splits", "importance")}

    def forward() -> torch.Tensor:
        return layer(features, given["position"], given["position"], given["extent"], **neighbors)

    def with_backward() -> None:
        forward().backward(given["gradient"])

    output = forward()
    output.backward(given["gradient"])
    results = (output.detach(), features.grad, layer.kernel.grad)
    np.savez(answer, **{name: r.numpy() for name, r in zip(("output", "features", "kernel"), results, strict=True)})
    print("ready", flush=True)
    for line in sys.stdin:
        features.grad = layer.kernel.grad = None
        began = time.process_time()
        if line.strip() == "forward":
            with torch.no_grad():
                forward()
        else:
            with_backward()
        print(time.process_time() - began, flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])

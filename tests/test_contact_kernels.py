"""The contact network's kernels: that they are the same function as the reference, and compiled ahead of a run."""

from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import pytest
import torch
from contact_beds import VARIANTS, at_walls, cluster, drum, furnished, network, with_memory

from gran_bench.surrogate.contact import compiling
from gran_bench.surrogate.contact.geometry import find_contacts
from gran_bench.surrogate.contact.kernels.frame import frame_adjoint, frame_forward


class TestFusedKernel:
    """The jitted forward and its hand-written adjoint against the reference and autograd, in float32."""

    @pytest.mark.parametrize("choices", VARIANTS)
    @pytest.mark.parametrize("room", ["drum", "periodic drum", "every wall"])
    def test_frames_and_all_gradients_are_those_of_the_reference(self, choices, room):
        scene = furnished() if room == "every wall" else drum(periodic=room == "periodic drum")
        bed = at_walls if room == "every wall" else partial(cluster, count=60)
        count = len(bed(scene).position)
        reference = network(scene, **choices)
        fused = network(scene, **choices, backend="fused")
        generator = torch.Generator().manual_seed(1)
        pull = [torch.randn((count, 3), generator=generator) for _ in range(3)]

        def frame(model):
            state = with_memory(model, scene, bed(scene))
            leaves = [state.position, state.velocity, state.angular_velocity]
            for leaf in leaves:
                leaf.requires_grad_()
            after = model(state, scene, 1.51)
            outputs = 1e3 * after.position, 10.0 * after.velocity, 0.25 * after.angular_velocity
            sum((o * p).sum() for o, p in zip(outputs, pull, strict=True)).backward()
            scales = (1e3, 10.0, 0.25)  # so that all gradients are per mm, or mm a frame
            return outputs, [leaf.grad / s for leaf, s in zip(leaves, scales, strict=True)]

        expected, expected_gradients = frame(reference)
        found, found_gradients = frame(fused)
        for e, f in zip(expected, found, strict=True):
            assert torch.allclose(e, f, rtol=1e-4, atol=1e-4)
        for e, f in zip(expected_gradients, found_gradients, strict=True):
            assert (e - f).norm() < 2e-4 * e.norm()
        for name, weight in reference.named_parameters():
            gradient = dict(fused.named_parameters())[name].grad
            assert (weight.grad - gradient).norm() < 2e-4 * weight.grad.norm(), name

    def test_threads_that_work_at_once_give_the_same_bits(self):
        scene = drum()
        model = network(scene, backend="fused", memory=True)

        def gradient(_):
            state = with_memory(model, scene, cluster(scene, 60))
            after = model(state, scene, 1.5)
            return torch.autograd.grad(after.position.sum() + after.velocity.sum(), list(model.parameters()))

        alone = gradient(0)
        with ThreadPoolExecutor(2) as pool:
            for together in pool.map(gradient, range(6)):
                assert all(torch.equal(a, b) for a, b in zip(alone, together, strict=True))


def test_kernels_compiled_ahead_are_the_ones_that_a_run_calls(monkeypatch, tmp_path):
    # Compiled in the run's own process they would sum in another order, and the first run would train other weights.
    compiling.main()
    scene = drum()
    model = network(scene, backend="fused", iterations=4, memory=True)
    state = with_memory(model, scene, cluster(scene, 60))
    assert len(find_contacts(scene, 1.5, state.position.numpy(), 0.06, 0.01).wall) > 1
    model(model(state, scene, 1.5), scene, 1.51).position.sum().backward()
    assert (len(frame_forward.signatures), len(frame_adjoint.signatures)) == (1, 1)
    started = []

    class Process:
        """Of the other process, how it ends."""

        def __init__(self, module: str, **_) -> None:
            started.append(module)

        def wait(self, patience: float) -> int:
            return self.status

    monkeypatch.setattr(compiling, "MARK", f"{tmp_path.name}.compiled")
    monkeypatch.setattr(compiling, "start_module", Process)
    assert compiling.kernels_missing("contact")
    assert not compiling.kernels_missing("radial")
    mark = Path(frame_forward.stats.cache_path) / compiling.MARK
    for Process.status, missing in ((1, True), (0, False)):  # where it fails, the run compiles for itself
        compiling.compile_kernels("contact")
        assert compiling.kernels_missing("contact") is missing
    mark.unlink()
    assert started == ["gran_bench.surrogate.contact.compiling"] * 2

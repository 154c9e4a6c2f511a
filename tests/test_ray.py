"""What `hydra/launcher=ray` refuses before any work; ``tests/faults/test_clusters.py`` has the real one."""

from __future__ import annotations

import importlib.util
import os
import socket

import pytest

from gran_bench.config.rules import ConfigError
from gran_bench.processes import MissingProgramError
from gran_bench.sweep.ray import RayLauncher

needs_ray = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs the package ray")


def test_a_missing_package_is_named_with_the_command_that_installs_it(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingProgramError, match=r"needs the package ray.*; pip install 'gran-bench\[ray\]'"):
        RayLauncher().check()


def test_a_job_that_this_machine_has_no_room_for_is_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name)
    most = os.cpu_count()
    with pytest.raises(ConfigError, match=rf"hydra\.launcher\.cpus={most + 1}: no node has so many; .* most {most}$"):
        RayLauncher(cpus=most + 1).check()


@needs_ray
def test_an_address_without_a_cluster_is_named_with_the_remedy():
    with socket.create_server(("127.0.0.1", 0)) as server:
        free = server.getsockname()[1]
    with pytest.raises(ConfigError, match=rf"address=127\.0\.0\.1:{free}: no Ray cluster there .*`ray start --head`"):
        RayLauncher(address=f"127.0.0.1:{free}").check()

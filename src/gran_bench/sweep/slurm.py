"""The jobs of a sweep on a Slurm cluster: submitit submits and requeues them, and Slurm's queue says which still live.

submitit would ask Slurm's accounting, which many clusters do not have. The queue remembers what has ended for minutes.
"""

import re
import subprocess
import time
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from gran_bench.config.launchers import SlurmConfig
from gran_bench.config.rules import ConfigError
from gran_bench.processes import require_program
from gran_bench.sweep.launcher import JobLauncher, last_words, require_package
from gran_bench.sweep.remote import RemoteJob
from gran_bench.sweep.task import GRACE_SECONDS, SAID

PROGRAMS = ("sbatch", "srun", "squeue", "scontrol", "scancel")
SUBMITTED = "_submitted.pkl"  # of submitit's file, after the job's id
LOOK_SECONDS = 1.0  # between two looks for results
QUEUE_SECONDS = 10.0  # between two looks into the queue
LATE_SECONDS = 20.0  # that a result may need to be seen through a shared file system, once its job has ended
WARNING_SECONDS = 90  # before a job's time limit, for an update and a checkpoint; less where the limit is short
STOPPED = ("CANCELLED", "DEADLINE", "REVOKED")  # states that somebody wanted
ENDED = (*STOPPED, "COMPLETED", "FAILED", "TIMEOUT", "NODE_FAIL", "BOOT_FAIL", "OUT_OF_MEMORY", "PREEMPTED")


class SlurmLauncher(JobLauncher):
    """Submit each job; one that is killed or reaches its time limit is requeued, as one whose node fails is by Slurm.

    Where this process is killed, its jobs stay in Slurm's queue. The same command waits for them.
    """

    schema = SlurmConfig
    elsewhere = True

    def __init__(self, **keys: Any) -> None:
        super().__init__(**keys)
        self._requeued: Counter[str] = Counter()
        self._gone: dict[str, float] = {}  # when a job was first seen to have ended
        self._next_look = 0.0

    def check(self) -> None:
        require_package("submitit")
        for program in PROGRAMS:
            require_program(program, "run the command where Slurm's programs are, or choose hydra/launcher=local")
        options = [f"--{name}" if value is True else f"--{name}={value}" for name, value in self._options().items()]
        tried = _slurm("sbatch", "--test-only", f"--time={self.config.minutes}", *options, "--wrap=true")
        if tried.returncode:
            why = tried.stderr.strip().splitlines()[:1] or ["it does not say why"]
            keys = ", ".join(f"{key}={getattr(self.config, key)}" for key in ("partition", "minutes", "cpus", "gpus"))
            why = why[0].removeprefix("sbatch: error: ")
            raise ConfigError(f"Slurm refuses jobs of hydra.launcher with {keys}: {why}; sinfo shows what there is")

    def start(self, overrides: list[str], number: int) -> Any:
        import submitit

        folder = self._folder(number)
        known = [path.name.removesuffix(SUBMITTED) for path in folder.glob(f"*{SUBMITTED}")]
        states = (_states() or {}) if known else {}
        for before in known:  # of commands that were killed
            if states.get(before, ENDED[0]) not in ENDED:
                self.tell(number, f"still Slurm's job {before}")
                return submitit.SlurmJob(folder, before)
        executor = submitit.SlurmExecutor(folder, max_num_timeout=self.config.retries)
        executor.update_parameters(
            job_name=self.task.name(number),
            time=self.config.minutes,
            ntasks_per_node=1,
            signal_delay_s=min(WARNING_SECONDS, 15 * self.config.minutes),
            setup=self.config.setup or None,
            srun_args=[f"--cpus-per-task={self.config.cpus}"],  # which srun does not take from sbatch
            additional_parameters=self._options(),
        )
        job = executor.submit(RemoteJob.of(self.task, overrides, number, forward=False))
        self.tell(number, f"Slurm's job {job.job_id}")
        return job

    def ended(self, running: Mapping[int, Any]) -> dict[int, int | str]:
        time.sleep(LOOK_SECONDS)
        results = {number: _result(job) for number, job in running.items()}
        # Any other exit code is of a life that was ended, after which Slurm may have started another.
        found = {number: end for number, end in results.items() if isinstance(end, str) or end in (0, SAID)}
        if found or time.monotonic() < self._next_look:
            return found
        self._next_look = time.monotonic() + QUEUE_SECONDS
        states = _states()
        for number, job in running.items() if states is not None else ():
            state, code = states.get(job.job_id, "not in the queue any more"), results[number]
            if job.job_id in states and state not in ENDED:
                self._gone.pop(job.job_id, None)
                continue
            gone = time.monotonic() - self._gone.setdefault(job.job_id, time.monotonic())
            if code is None and gone < LATE_SECONDS:
                continue
            why = f"Slurm's job {job.job_id} is {state}; what it said is in {job.paths.stderr}"
            if code is not None:
                why = last_words(code, "a larger hydra.launcher.memory_gb")
            if self._requeue(job, state):
                self.tell(number, f"{why}; it is requeued")
            else:
                found[number] = why
        return found

    def stop(self, running: Mapping[int, Any]) -> None:
        left, patience = {job.job_id for job in running.values()}, time.monotonic() + 2 * GRACE_SECONDS
        if left:
            _slurm("scancel", *left)
        while left and time.monotonic() < patience:
            time.sleep(LOOK_SECONDS)
            states = _states()
            left = {job for job in left if states is None or states.get(job, ENDED[0]) not in ENDED}

    def _folder(self, number: int) -> Path:
        """For what submitit keeps of a run, in which a later command finds its job."""
        sweep = self.task.sweep
        return self.folder / "slurm" / (str(number) if sweep is None else Path(sweep.jobs[number].log_name).stem)

    def _options(self) -> dict[str, Any]:
        """Of sbatch, by their long names."""
        config = self.config
        given = {
            "partition": config.partition,
            "cpus-per-task": config.cpus,
            "gpus": config.gpus or None,
            "mem": None if config.memory_gb is None else f"{round(1024 * config.memory_gb)}M",
            "requeue": True,
        }
        return {name: value for name, value in given.items() if value is not None} | config.options

    def _requeue(self, job: Any, state: str) -> bool:
        if state in STOPPED or self._requeued[job.job_id] >= self.config.retries:
            return False
        job.paths.result_pickle.unlink(missing_ok=True)
        if _slurm("scontrol", "requeue", job.job_id).returncode:
            return False
        self._requeued[job.job_id] += 1
        del self._gone[job.job_id]
        return True


def _result(job: Any) -> int | str | None:
    """The exit code of a job's latest life, or why submitit gave it up; None while it is without a result."""
    if not job.paths.result_pickle.exists():
        return None
    if (error := job.exception()) is None:
        return job.result()
    lines = re.findall(r"^[\w.]+(?:Error|Exception): (.+)$", str(error), re.MULTILINE)
    return " ".join(lines[-1:]) or f"it ended in an error; what it said is in {job.paths.stderr}"


def _states() -> dict[str, str] | None:
    """The states of this user's jobs, ended ones included, by id; None where Slurm does not answer."""
    asked = _slurm("squeue", "--me", "--noheader", "--states=all", "--format=%i %T")
    return None if asked.returncode else dict(line.split() for line in asked.stdout.splitlines())


def _slurm(*words: str) -> subprocess.CompletedProcess[str]:
    with suppress(subprocess.TimeoutExpired):
        return subprocess.run(words, capture_output=True, text=True, timeout=GRACE_SECONDS, check=False)
    return subprocess.CompletedProcess(words, 1, "", "it does not answer")

"""Jobs of a cluster in place of processes of this machine; submitit hands them to SLURM.

The folder of the results must be the same on all nodes, and so must this installation. What submitit writes
(batch files, what a job prints before it works) is in its folder `jobs`.
"""

import fcntl
import os
import pickle
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from pixel2catch.errors import StudyError
from pixel2catch.installation import needs_extra

if TYPE_CHECKING:
    from submitit import AutoExecutor

Returned = TypeVar("Returned")

CLUSTER = "slurm"  #: Whose jobs submitit starts.
LOOK_SECONDS = 1.0  #: Time between two looks at the jobs [s].
GRACE_SECONDS = 60.0  #: Time of a command to end in order [s]. Source: ours; submitit warns 90 s before.


@dataclass(frozen=True, kw_only=True)
class Cluster:
    """Where the parts of a study are computed."""

    #: Where: local, in processes of this machine, or slurm, as jobs of a cluster on whose login node this
    #: command runs; they write the same files. It waits for the jobs and cancels them where it is stopped.
    launcher: Literal["local", "slurm"] = "local"
    #: What every job asks the cluster for, as NAME=VALUE in submitit's words, such as timeout_min=240
    #: cpus_per_task=4 gpus_per_node=1 slurm_partition=gpu.
    slurm: tuple[str, ...] = ()

    @property
    def is_here(self) -> bool:
        """Whether that is on this machine."""
        return self.launcher == "local"

    def executor(self, folder: Path) -> "AutoExecutor | None":
        """What takes jobs, with its files in the folder `jobs` of the results; none on this machine.

        Raises:
            StudyError: If there is no cluster, submitit is missing, or it does not know what is asked for.
        """
        if self.is_here:
            if self.slurm:
                raise StudyError("--slurm is for jobs of a cluster; give --launcher slurm, or leave it out.")
            return None
        with needs_extra("slurm", "--launcher slurm needs submitit", StudyError):
            from submitit import AutoExecutor
        asked = {name: value for name, _, value in (each.partition("=") for each in self.slurm)}
        try:
            executor = AutoExecutor(folder.absolute() / "jobs", cluster=CLUSTER)
            executor.update_parameters(
                name=folder.name, **{n: int(v) if v.isdigit() else v for n, v in asked.items()}
            )
        except (RuntimeError, NameError, AssertionError, ValueError) as error:
            raise StudyError(f"the cluster takes no such jobs: {error}") from error
        return executor


class SubmittedCommand:
    """A command that is a job of a cluster; it has what is asked of a `subprocess.Popen`."""

    def __init__(
        self, executor: "AutoExecutor", command: Sequence[str], log: Path, environment: Mapping[str, str]
    ) -> None:
        """Hand the command over; what it prints is added to its log."""
        self._job, self._log = executor.submit(run_command, command, log.absolute(), environment), log
        self._is_cancelled = False
        self.returncode: int | None = None  #: Exit status, once it is over.

    def poll(self) -> int | None:
        """Exit status, or nothing while the job waits or works; -1 for a job that the cluster ended."""
        if self.returncode is None and self._job.done():
            # Of a job without a result submitit waits for one, 15 s.
            error = "cancelled" if self._is_cancelled else self._job.exception()
            self.returncode = -1 if error else self._job.result()
            if error:
                with open(self._log, "a", encoding="utf-8") as log:
                    log.write(f"job {self._job.job_id} was ended: {_reason(str(error))}\n")
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the exit status, so many seconds.

        Raises:
            subprocess.TimeoutExpired: If that was too short.
        """
        deadline = time.monotonic() + (float("inf") if timeout is None else timeout)
        while (status := self.poll()) is None:
            if time.monotonic() >= deadline:
                raise subprocess.TimeoutExpired(str(self._job.job_id), timeout or 0.0)
            time.sleep(LOOK_SECONDS)
        return status

    def terminate(self) -> None:
        """Cancel the job; the cluster asks the command to end, and kills it some time later."""
        self._is_cancelled = True
        self._job.cancel(check=False)

    kill = terminate


def run_command(command: Sequence[str], log: Path, environment: Mapping[str, str]) -> int:
    """Run a command to its end, and return its exit status; only once at a time for a log."""
    with open(log, "ab") as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        process = subprocess.Popen(
            list(command),
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            env=os.environ | dict(environment),
        )
        try:
            return process.wait()
        finally:
            if process.poll() is None:  # the cluster, or somebody, ends the job
                process.terminate()
                process.wait(GRACE_SECONDS)


def in_jobs(
    executor: "AutoExecutor",
    begin: Callable[[], None],
    function: Callable[..., Returned],
    calls: Sequence[tuple[Any, ...]],
) -> Iterator[tuple[int, Returned]]:
    """Yield number and returned value of every call of a module's function as soon as it is done.

    Each is a job, which first calls `begin`. Jobs that are not done are cancelled with the first error.

    Raises:
        StudyError: If a job failed, or was ended.
    """
    with executor.batch():
        jobs = [executor.submit(_call, begin, pickle.dumps((function, call))) for call in calls]
    waiting = dict(enumerate(jobs))
    try:
        while waiting:
            for number in [number for number, job in waiting.items() if job.done()]:
                job = waiting.pop(number)
                if error := job.exception():
                    raise StudyError(
                        f"job {job.job_id} failed: {_reason(str(error))}; see {job.paths.stderr}. What was "
                        "finished is kept: the same command goes on from there."
                    )
                yield number, job.result()
            time.sleep(LOOK_SECONDS)
    finally:
        for job in waiting.values():
            job.cancel(check=False)


def _call(begin: Callable[[], None], payload: bytes) -> Any:
    """Call a function in a job; what is sent may be known only once the job has begun."""
    begin()
    function, call = pickle.loads(payload)
    return function(*call)


def _reason(text: str) -> str:
    """The line of an error with its name, of what submitit tells."""
    lines = [line for line in text.splitlines() if line.strip("- ")]
    return next((line for line in reversed(lines) if "Error: " in line), lines[0])

"""Rendering of a shard of a campaign in a process of its own.

The process ends with its shard, and with it the memory that Mitsuba does not give back. It ends, too, when the process
that has started it does. Its standard input holds the store, the shard, and the runs that are not to be rendered, with
the reasons; it writes one line of JSON for each event: ``begin`` and ``end`` of a run, ``done`` or ``error``.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np

from mitransient_lidar.campaigns.store import DONE, FAILED, PLANNED, Store
from mitransient_lidar.core.errors import UserError

#: Time between two writes of a shard that is not finished [s].
_INTERVAL_S = 60.0

#: Number of times that the process may end while it renders a run before this run has failed.
_MOST_DEATHS = 2

#: Variables of the environment with numbers of threads of numerical libraries.
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

Report = Callable[[int, int], None]


def render_in_process(path: str, shard: int, retry: bool = False, report: Report | None = None) -> tuple[int, int]:
    """Render the runs of a shard that are not done in a new process; return the numbers of runs done and failed.

    Parameters
    ----------
    path
        Folder of the store.
    shard
        Number of the shard.
    retry
        Whether to render runs that have failed, too.
    report
        Called with the numbers of runs done and failed after each run.

    Raises
    ------
    UserError
        If the store cannot be read or written.
    RuntimeError
        If the process ends before its first run.
    """
    reasons: dict[int, str] = {}
    deaths: Counter[int] = Counter()
    while True:
        ended = _one_process({"store": path, "shard": shard, "retry": retry, "failed": reasons}, report)
        if isinstance(ended, tuple):
            return ended
        run, reason = ended
        deaths[run] += 1
        if deaths[run] >= _MOST_DEATHS:
            reasons[run] = reason


def _one_process(order: dict[str, Any], report: Report | None) -> tuple[int, int] | list[Any]:
    """Return the numbers of runs done and failed, or the run in which the process ended, and why."""
    environment = {**os.environ, **dict.fromkeys(_THREADS, "1")}
    # A session of its own: Ctrl-C is for the process that has started it.
    with subprocess.Popen(
        [sys.executable, "-m", "mitransient_lidar.campaigns.shard"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        start_new_session=True,
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stderr is not None
        told: list[str] = []
        reader = threading.Thread(target=lambda: told.extend(process.stderr or ()), daemon=True)
        reader.start()
        run: int | None = None
        try:
            process.stdin.write(json.dumps(order) + "\n")
            process.stdin.flush()
            for line in process.stdout:
                if not line.startswith("{"):
                    continue
                event = json.loads(line)
                if "done" in event:
                    return event["done"], event["failed"]
                if "error" in event:
                    raise UserError(event["error"])
                run = event.get("begin", run)
                if "end" in event and report is not None:
                    report(*event["end"])
        except BrokenPipeError:
            pass
        finally:
            process.kill()
        code = process.wait()
        reader.join(timeout=5)
        last = " ".join((told or ["without a message"])[-1].split())
        why = f"by signal {-code}" if code < 0 else f"with exit code {code}: {last}"
        if run is None:
            raise RuntimeError(f"the process of shard {order['shard']} ended {why}")
        return [run, f"the process ended {why}"]


def render_shard(path: str, shard: int, retry: bool, failed: dict[int, str], tell: Callable[..., None]) -> None:
    """Render the runs of a shard that are not done, and write them."""
    store = Store(path)
    renderer, runs = store.renderer(), store.runs_of(shard)
    inputs = store.inputs(runs)
    status, errors, arrays = store.read(shard)
    if retry:
        status[status == FAILED] = PLANNED
    counts = [int(np.count_nonzero(status == value)) for value in (DONE, FAILED)]
    written = time.monotonic()
    for place in np.flatnonzero(status == PLANNED):
        number = runs.start + int(place)
        values = {name: column[place].item() for name, column in inputs.items()}
        tell(begin=number)
        # The random sea, of runs that fail too.
        for name, value in renderer.inputs(number, values).items():
            if name in arrays:
                arrays[name][place] = value
        try:
            if number in failed:
                raise UserError(failed[number])
            found = renderer.arrays(number, values)
            for name, array in found.items():
                if name not in arrays or array.values.shape != arrays[name].shape[1:]:
                    raise UserError(
                        f"{name} of the run has the shape {array.values.shape}, and that of the first run another one: "
                        "all runs must have the same pixels and origins of light"
                    )
            for name, array in found.items():
                arrays[name][place] = array.values
            status[place], errors[place] = DONE, ""
        except UserError as error:
            status[place], errors[place] = FAILED, " ".join(str(error).split())
        counts[0 if status[place] == DONE else 1] += 1
        tell(end=counts)
        if time.monotonic() - written > _INTERVAL_S:
            store.write(shard, status, errors, arrays)
            written = time.monotonic()
    store.write(shard, status, errors, arrays)
    tell(done=counts[0], failed=counts[1])


def _main() -> None:
    """Render the shard that standard input names."""
    import logging

    import drjit as dr

    order = json.loads(sys.stdin.readline())
    threading.Thread(target=_end_with_parent, daemon=True).start()
    # What a run tells belongs to its result; a campaign has thousands.
    logging.getLogger("mitransient_lidar").setLevel(logging.ERROR)
    dr.set_thread_count(1)
    # Mitsuba may write to standard output, too.
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)

    def tell(**event: Any) -> None:
        out.write(json.dumps(event) + "\n")
        out.flush()

    try:
        failed = {int(run): reason for run, reason in order["failed"].items()}
        render_shard(order["store"], order["shard"], order["retry"], failed, tell)
    except UserError as error:
        tell(error=str(error))


def _end_with_parent() -> None:
    """End this process when its standard input does."""
    sys.stdin.read()
    os._exit(1)


if __name__ == "__main__":
    _main()

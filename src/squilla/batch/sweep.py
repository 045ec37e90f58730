"""Sweeps: one function for every combination of its arguments, in a journal as captures are."""

import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from squilla import __version__
from squilla.batch.workers import crew, one_thread
from squilla.errors import InputError
from squilla.files.disk import make_folder
from squilla.files.journal import Journal, stamp
from squilla.files.tables import write_listed

Plain = str | int | float | bool | None


def sweep(
    work: Callable[..., Mapping[str, Plain]],
    over: Mapping[str, Sequence[Plain]],
    folder: str | Path,
    *,
    fixed: Mapping[str, Plain | Path] | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Callable[[int, int], None] = lambda ended, of: None,
) -> list[dict[str, Plain]]:
    """Call a function for every combination of arguments; go on where an earlier run ended.

    Parameters
    ----------
    work : function
        Of a module, so that other processes find it; takes the names of `over` and `fixed` and
        returns plain numbers and text.
    over : mapping of name to values
    folder : str or Path
        Gets ``journal.jsonl``, which notes each combination when it is done, and in the end
        ``table.csv``, a row for each in the order of `over`. A longer list of values later adds to
        it.
    fixed : mapping, optional
        Arguments that are the same for all; a file counts by what it is, not by its name alone.
    workers, scheduler, progress
        As in `squilla.batch.captures.reconstruct_all`.

    Returns
    -------
    list of dict
        Arguments and results of each; those that failed have none but ``failed``, the reason.

    Raises
    ------
    InputError
        If there is nothing to do, the journal is of another sweep, or the disk refuses.
    """
    folder, fixed = Path(folder), dict(fixed or {})
    cases = [dict(zip(over, values, strict=True)) for values in itertools.product(*over.values())]
    if not cases:
        raise InputError("There is nothing to sweep over: a list of values is empty.")
    named = {json.dumps(case, sort_keys=True): case for case in cases}
    state = {
        "sweep": f"{work.__module__}.{work.__qualname__}",
        "fixed": {
            name: stamp(value) if isinstance(value, Path) else value
            for name, value in fixed.items()
        },
        "software": __version__,
    }
    make_folder(folder)
    with Journal(folder / "journal.jsonl", state) as journal:
        told = {name: row for name, row in journal.done.items() if name in named}
        progress(len(told), len(named))
        missing = {name: case for name, case in named.items() if name not in told}
        with crew(len(missing), workers, scheduler) as lent:
            tasks = ((name, (work, {**fixed, **case})) for name, case in missing.items())
            for name, row in lent.each(_one, tasks):
                journal.write(name, row)
                told[name] = row
                progress(len(told), len(named))
    rows = [{**case, **told[name]} for name, case in named.items()]
    heads = list(dict.fromkeys(key for row in rows for key in row))
    cells = [[str(row.get(head, "")) for head in heads] for row in rows]
    write_listed(folder / "table.csv", heads, cells)
    return rows


def _one(work: Callable[..., Mapping[str, Plain]], arguments: dict[str, Any]) -> dict[str, Plain]:
    """Do the work for one combination, in one thread; return what the journal shall say of it."""
    try:
        with one_thread():
            return dict(work(**arguments))
    except InputError as error:
        return {"failed": str(error)}

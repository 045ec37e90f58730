"""What a long run has done so far, so that it can go on after it was killed."""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from squilla.errors import InputError
from squilla.files.disk import existing


class Journal:
    """A line of JSON for the run and one for each item that ended; held by one run alone.

    Parameters
    ----------
    path : Path
        Of the journal, made if it is not there.
    recipe : dict
        All that decides what comes out; a run may go on only with the same.

    Attributes
    ----------
    done : dict
        What was noted of each item that did not fail, by name, in the order of their ends.
    """

    def __init__(self, path: Path, recipe: dict[str, Any]):
        self.path = path
        self.done: dict[str, dict[str, Any]] = {}
        self._recipe = recipe

    def __enter__(self) -> "Journal":
        with stop_on_disk_error(self.path):
            self._stream = self.path.open("a+", encoding="utf-8")
        try:
            _hold(self._stream)
            self._read()
        except BaseException:
            self._stream.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()

    def write(self, name: str, told: dict[str, Any]) -> None:
        """Note that an item has ended; one that failed says so under "failed"."""
        self._append({"name": name, **told})

    def _read(self) -> None:
        self._stream.seek(0)
        try:
            *lines, cut = self._stream.read().split("\n")
        except UnicodeDecodeError as error:
            raise InputError(f"{self.path} is damaged ({error}); give another output.") from error
        if cut:  # a killed run did not finish the last line
            self._stream.truncate(len("\n".join([*lines, ""]).encode()))
        try:
            first, *told = [json.loads(line) for line in lines] or [None]
            for line in told:
                name = str(line.pop("name"))
                self.done.pop(name, None)
                if "failed" not in line:
                    self.done[name] = line
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise InputError(f"{self.path} is damaged ({error}); give another output.") from error
        if first is None:
            self._append({"recipe": self._recipe})
        elif first != {"recipe": self._recipe}:
            begun = first.get("recipe") if isinstance(first, dict) else None
            begun = begun if isinstance(begun, dict) else {}
            changed = [key for key, value in self._recipe.items() if begun.get(key) != value]
            raise InputError(
                f"{self.path} was begun with another {' and '.join(changed) or 'recipe'}; "
                "give another output."
            )

    def _append(self, line: dict[str, Any]) -> None:
        with stop_on_disk_error(self.path):
            self._stream.write(json.dumps(line) + "\n")
            self._stream.flush()
            os.fsync(self._stream.fileno())


def _hold(stream: Any) -> None:
    """Keep other runs away from the journal for as long as it is open."""
    try:
        import fcntl
    except ImportError:  # Windows: there two runs at once are not noticed
        return
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        raise InputError(f"Another run holds {stream.name}; wait for its end.") from error


def stamp(path: str | Path) -> dict[str, Any]:
    """Return what tells whether a file is the one that it was."""
    path = existing(path).resolve()
    status = path.stat()
    return {"file": str(path), "bytes": status.st_size, "changed": status.st_mtime_ns}


@contextmanager
def stop_on_disk_error(path: Path) -> Iterator[None]:
    """Turn what the disk refuses into an InputError that ends the run."""
    try:
        yield
    except OSError as error:
        raise InputError(
            f"{path} could not be written: {error.strerror or error}. What is done is whole; run "
            "again to go on."
        ) from error

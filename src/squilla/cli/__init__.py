"""The command line, ``squilla``."""

import sys
import warnings


def main() -> None:
    """Run the command line; what the person can mend is said in one line, with exit code 2.

    Interrupted, it ends with exit code 130.
    """
    from squilla.cli.app import app
    from squilla.errors import InputError

    warnings.showwarning = _warn
    try:
        app(prog_name="squilla")
    except InputError as error:
        print(f"squilla: {error}", file=sys.stderr)
        sys.exit(2)


def _warn(message: Warning | str, *_: object, **__: object) -> None:
    """Say a warning as an error is said: to the person, not to who wrote the line."""
    print(f"squilla: {message}", file=sys.stderr)

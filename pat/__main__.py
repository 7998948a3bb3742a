"""`python -m pat` is `pat`: torchrun starts it so."""

import gc
import os
import sys


def main() -> None:
    """Run `pat`; an interruption while it is still being imported is one line, too.

    Torch's threads sleep while they wait: spinning, they took the cores from each other and from other
    processes. Cycles of objects are sought a hundred times less often: there are few, and imports alone took
    .4 s for them.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    gc.set_threshold(70_000, 20)
    try:
        from .app.cli.main import main as command
        from .support.memory import keep_freed

        keep_freed()
        command()
    except KeyboardInterrupt:
        print("pat: interrupted", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()

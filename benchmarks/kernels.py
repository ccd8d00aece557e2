"""List the kernels that a run calls, for `gnss_sem_map.cli.compile_ahead`, by a demo with nothing compiled before.

python benchmarks/kernels.py

Needed after a kernel was added or takes other types: `tests/gnss_sem_map/test_compile_ahead.py` tells when. Kernels of
the simulator are left out: a demo calls them at once, and a run never.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numba
from numba.core import event, types

LEFT_OUT = "gnss_sem_map.simulation."


class Calls(event.Listener):
    """A line for every kernel that is compiled because Python calls it, and not because another kernel does."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self._depth = 0

    def on_start(self, started: event.Event) -> None:
        """Called when numba begins to compile a function, by one thread at a time."""
        function = started.data["dispatcher"].py_func
        if self._depth == 0 and not function.__module__.startswith(LEFT_OUT):
            arguments = ", ".join(map(written, started.data["args"]))
            self.lines.append(f"{function.__module__} {function.__name__} {arguments}\n")
        self._depth += 1

    def on_end(self, ended: event.Event) -> None:
        """Called when it is compiled, with all that it calls."""
        self._depth -= 1


def written(kind: types.Type) -> str:
    """A type as numba's signatures have it, such as `float64[:, ::1]`."""
    if isinstance(kind, types.Array) and kind.mutable:
        axes = [":"] * kind.ndim
        if kind.layout != "A":
            axes[-1 if kind.layout == "C" else 0] = "::1"
        return f"{written(kind.dtype)}[{', '.join(axes)}]"
    return "boolean" if kind == types.boolean else repr(kind)


def main() -> None:
    """Write the list, in the order of the first calls."""
    with TemporaryDirectory() as folder:
        # before kernels are imported, and for this process alone: not for the one that compiles ahead
        numba.config.CACHE_DIR = f"{folder}/compiled"
        from gnss_sem_map.cli.compile_ahead import LIST
        from gnss_sem_map.cli.demo import demonstrate

        calls = Calls()
        with event.install_listener("numba:compile", calls):
            demonstrate(Path(folder) / "demo")
    LIST.write_text("".join(calls.lines))
    print(f"{len(calls.lines)} kernels in {LIST}")


if __name__ == "__main__":
    main()

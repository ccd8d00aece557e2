"""A segmenter whose answer never comes, as of a large network on a slow machine."""

from __future__ import annotations

import threading


class Never:
    """Waits for ever."""

    class_names = ("road", "building")

    def __call__(self, pixels: object) -> None:
        """No answer."""
        threading.Event().wait()


never = Never()

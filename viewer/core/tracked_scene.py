"""How far a scene of the viewer is, from its photographs to its refinement. Needs no window.

    photograph --request--> predicting --receive--> refining --receive--> refined
        ^                     |    |                 |    ^
        +------ cancel -------+    | receive  cancel |    | request
                                   | a final scene   v    |
                                   +--------------> predicted

It is `failed` if it cannot be predicted, refined or drawn. A scene of a tour that is dropped from memory keeps its
state, and a request predicts it again.
"""

from __future__ import annotations

from typing import Literal

from pansplat_viewer.core.loader import LoadedScene, SceneEntry

State = Literal["photograph", "predicting", "predicted", "refining", "refined", "failed"]


class TrackedScene:
    """One scene, and how far it is.

    Attributes:
        entry: what it is made from.
        state: see the module.
        loaded: the newest scene; None before it is predicted, and while it is not in memory.
    """

    def __init__(self, entry: SceneEntry) -> None:
        """Its photographs are all there is."""
        self.entry = entry
        self.state: State = "photograph"
        self.loaded: LoadedScene | None = None

    @property
    def is_known(self) -> bool:
        """Whether it has been predicted, also if the scene is not in memory any more."""
        return self.state in ("predicted", "refining", "refined")

    def request(self) -> None:
        """The loader begins to predict it, or to refine the prediction that is there."""
        self.state = "predicting" if self.loaded is None else "refining"

    def receive(self, loaded: LoadedScene) -> None:
        """The loader has predicted or refined it."""
        is_refined = loaded.is_final and self.state == "refining" and self.loaded is not None
        self.state = "refined" if is_refined else "predicted" if loaded.is_final else "refining"
        self.loaded = loaded

    def cancel(self) -> None:
        """The loader makes something else: a prediction stays, and is not refined."""
        if self.state in ("predicting", "refining"):
            self.state = "photograph" if self.loaded is None else "predicted"

    def fail(self) -> None:
        """It cannot be predicted, refined or drawn; a prediction that is there stays."""
        self.state = "failed"

    def drop(self) -> LoadedScene:
        """Take the scene out of memory, and return it; it stays known."""
        assert self.loaded is not None
        loaded, self.loaded = self.loaded, None
        return loaded

"""The life of a scene in the viewer, from its photographs to its refinement. Needs no window.

    photograph --request--> predicting --receive--> refining --receive--> refined
        ^                     |    |                 |    ^                  |
        +------ cancel -------+    | receive  cancel |    | request          | revert
                                   | a final scene   v    |                  |
                                   +--------------> predicted <--------------+

It is `failed` if it cannot be predicted, refined or drawn. A scene of a tour that is dropped from memory keeps its
state, and a request predicts it again.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Literal

from pansplat_viewer.scene.loader import LoadedScene, SceneEntry

if TYPE_CHECKING:
    from pansplat.gaussians.scene import Scene

State = Literal["photograph", "predicting", "predicted", "refining", "refined", "failed"]


class SceneLife:
    """One scene, and how far it is.

    Attributes:
        entry: what it is made from.
        state: see the module.
        loaded: the newest scene; None before it is predicted, and while it is not in memory.
        prediction: the scene before the refinement; None before `refined`, and where it is not kept.
    """

    def __init__(self, entry: SceneEntry) -> None:
        """Its photographs are all there is."""
        self.entry = entry
        self.state: State = "photograph"
        self.loaded: LoadedScene | None = None
        self.prediction: Scene | None = None

    @property
    def is_known(self) -> bool:
        """Whether it has been predicted, also if the scene is not in memory any more."""
        return self.state in ("predicted", "refining", "refined")

    def request(self) -> None:
        """The loader begins to predict it, or to refine the prediction that is there."""
        self.state = "predicting" if self.loaded is None else "refining"

    def receive(self, loaded: LoadedScene, *, keep_prediction: bool = True) -> None:
        """The loader has predicted or refined it; `keep_prediction` keeps the scene before a refinement."""
        is_refined = loaded.is_final and self.state == "refining" and self.loaded is not None
        if is_refined and keep_prediction and self.loaded is not None:
            self.prediction = self.loaded.scene
        self.state = "refined" if is_refined else "predicted" if loaded.is_final else "refining"
        self.loaded = loaded

    def cancel(self) -> None:
        """The loader makes something else: a prediction stays, and is not refined."""
        if self.state in ("predicting", "refining"):
            self.state = "photograph" if self.loaded is None else "predicted"

    def fail(self) -> None:
        """It cannot be predicted, refined or drawn; a prediction that is there stays."""
        self.state = "failed"

    def revert(self) -> None:
        """Go back to the prediction, because the renderer refuses the refined scene."""
        if self.prediction is not None and self.loaded is not None:
            self.loaded, self.prediction = replace(self.loaded, scene=self.prediction, facts=None), None
            self.state = "predicted"

    def drop(self) -> LoadedScene:
        """Take the scene out of memory, and return it; it stays known."""
        assert self.loaded is not None
        loaded, self.loaded, self.prediction = self.loaded, None, None
        return loaded

"""One of the people in a recording: a model of his or her own, and what is remembered beside the pose.

Left-camera frame; metres and seconds.
"""

import math
from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.pipeline import StereoToPose
from torchpose.registration.vem import Observation, Registration
from torchpose.tracking.location import Location, nowhere
from torchpose.vision.faces import FaceMemory
from torchpose.vision.skin import SkinModel


class Follower:
    """One person: a model of the person's own, and what is known beside the pose."""

    def __init__(self, model: StereoToPose, sized: bool):
        self.model = model
        self.location: Location = nowhere(model.size.new_zeros(1, 3))
        self.clothes: Tensor | None = None  # (1, bins), a running mean
        self.face: FaceMemory | None = None
        self.face_time = -math.inf  # s
        self.seen = 0  # frames with points
        self.known = False  # whether this person was ever there
        self.sized = sized
        # s, and m to the right and away, of the trunk in the last of a walk's span
        self.trail: Float[Tensor, "places 3"] = torch.zeros(0, 3, dtype=torch.float64)
        self.heights: list[float] = []  # m, in frames that show all of the person
        self.samples: list[tuple[float, Observation, Registration]] = []  # for the size

    def state(self) -> dict[str, Tensor]:
        """What the next frame starts from, as tensors."""
        numbers = torch.tensor([self.seen, self.known, self.sized, self.face_time], dtype=torch.float64)
        state = self.model.state() | {"follower": numbers}
        state |= {"trail": self.trail, "heights": torch.tensor(self.heights, dtype=torch.float64)}
        state |= {f"location_{name}": value for name, value in self.location.state().items()}
        if self.clothes is not None:
            state["clothes"] = self.clothes
        if self.face is not None:
            state |= {"face": self.face.box}
            state |= {f"skin_{name}": value for name, value in vars(self.face.skin).items()}
        return {name: value.clone() for name, value in state.items()}

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Go on from a `state`; samples for the size are gathered anew."""
        like = self.model.size
        self.model.restore(state)
        seen, known, sized, self.face_time = state["follower"].tolist()
        self.seen, self.known, self.sized = int(seen), bool(known), bool(sized)
        where = {
            name.removeprefix("location_"): value.to(like.device)
            for name, value in state.items()
            if name.startswith("location_")
        }
        self.location = Location.restore(where)
        self.trail, self.heights = state["trail"], state["heights"].tolist()
        self.clothes = state["clothes"].to(like) if "clothes" in state else None
        self.face = None
        if "face" in state:
            skin = {name[5:]: value.to(like) for name, value in state.items() if name.startswith("skin_")}
            self.face = FaceMemory(state["face"].to(like), SkinModel(**skin))

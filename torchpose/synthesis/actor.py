"""How a drawn person looks: cloth, skin and a face on the super-quadrics.

Textures stand in each rigid body's own frame (m), so that the cloth moves with the limb.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from torchpose.body.model import BodyModel
from torchpose.body.superquadric import DisplayModel, Material, Person
from torchpose.synthesis.motion import random_stream
from torchpose.synthesis.room import OCTAVES, SolidTexture

CONTRAST = (0.07, 0.22, 0.17, 0.17, 0.20)  # of the texture of each Material
PRINT = (0.0, 0.0, 0.30, 0.10, 0.0)  # strength of large blots on it


class Actor(nn.Module):
    """One person's shapes and what they are painted with."""

    colours: Tensor
    contrast: Tensor
    prints: Tensor
    shifts: Tensor
    bodies: Tensor

    def __init__(self, body: BodyModel, person: Person):
        super().__init__()
        self.display = DisplayModel(body, person)
        self.head = body.body_names.index("head")
        self.texture = SolidTexture(random_stream("cloth", person.pattern))
        shifts = torch.rand(len(body.body_names), 3, generator=random_stream("limbs", person.pattern))
        constants = {
            "colours": torch.tensor(person.colours),
            "contrast": torch.tensor(CONTRAST),
            "prints": torch.tensor(PRINT),
            "bodies": torch.tensor(self.display.bodies),
            "shifts": shifts,  # m: each limb is cut from another place of the cloth
        }
        for name, value in constants.items():
            self.register_buffer(name, value, persistent=False)

    def paint(
        self,
        local: Float[Tensor, "num 3"],
        part: Int[Tensor, " num"],
        footprint: Float[Tensor, " num"],
    ) -> Float[Tensor, "num 3"]:
        """RGB reflectance at points of the parts, in the parts' frames, seen with a pixel of `footprint` m."""
        display = self.display
        on_body = (display.frames[part] * local[:, None]).sum(-1) + display.offsets[part]
        along = local[:, 2] / display.shapes.size[part, 2]
        body = self.bodies[part]
        material = torch.where(along <= display.cuts[part], display.materials[part], Material.SKIN)
        cloth = on_body + self.shifts[body]
        noise = self.texture(cloth, footprint)
        blots = self.texture.octave(cloth, len(OCTAVES) - 2)[:, 0]
        tone = 1 + self.contrast[material] * noise + self.prints[material] * blots
        colour = self.colours[material] * tone[:, None]
        face = (body == self.head) & (material == Material.SKIN)
        painted = colour * _face(on_body / display.head_scale)
        return torch.where(face[:, None], painted, colour).clamp(0.02, 1)


def _face(at: Float[Tensor, "num 3"]) -> Float[Tensor, "num 3"]:
    """Factors of the skin's colour for a face painted on the front of the head, at points in its frame at
    size 1 (m).
    """
    x, y, z = at.unbind(-1)
    side = x.abs()

    def spot(dx: float, dy: float, wide: float, high: float) -> Tensor:
        """A soft ellipse around (+-dx, dy), 1 inside."""
        return torch.sigmoid(6 * (1 - ((side - dx) / wide) ** 2 - ((y - dy) / high) ** 2))

    front = torch.sigmoid((-z - 0.035) / 0.008)
    white, iris = spot(0.031, -0.160, 0.017, 0.008), spot(0.031, -0.160, 0.0075, 0.0085)
    brow, socket = spot(0.032, -0.181, 0.022, 0.006), spot(0.032, -0.166, 0.026, 0.018)
    nostril, mouth = spot(0.008, -0.108, 0.006, 0.004), spot(0.0, -0.083, 0.026, 0.0075)
    factor = (
        (1 - 0.35 * socket) * (1 + 0.6 * white) * (1 - 0.9 * iris) * (1 - 0.65 * brow) * (1 - 0.5 * nostril)
    )
    lips = torch.stack((1 - 0.25 * mouth, 1 - 0.55 * mouth, 1 - 0.5 * mouth), -1)
    return 1 + front[:, None] * (factor[:, None] * lips - 1)

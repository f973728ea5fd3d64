"""A part likelihood of your own, an image likelihood as (3.9): bare skin is a head, a hand or maybe a forearm.

python examples/new_likelihood.py [FRAMES]

It stands in for the built-in colours, which learn in the run, so that one sees what it does. The recording is rendered,
so the true part of each point and the true joints are known; the method does not see them.
"""

import sys

import torch

import torchpose as tp
from torchpose.registration.colour import ColourConfig
from torchpose.rendered import RenderedRecording
from torchpose.synthesis.database import make_recording, synthetic_camera
from torchpose.vision.skin import skin_prior, skin_probability

BARE = {"head": 0.7, "hand": 0.95, "forearm": 0.5}  # share of a part's surface that is bare skin; others 0.05


class Skin(tp.PartLikelihood):
    """log(s p + (1 - s)(1 - p)) of a part whose share s is bare, at a pixel that is skin with probability p."""

    share: torch.Tensor  # (parts,)

    def __init__(self, segment_names: tuple[str, ...]):
        super().__init__(segment_names)
        shares = [next((s for part, s in BARE.items() if part in name), 0.05) for name in self.segment_names]
        self.register_buffer("share", torch.tensor(shares))

    def forward(self, evidence: tp.Evidence) -> torch.Tensor:  # (B, points, parts), nats
        memory, cloud = evidence.faces.memory, evidence.cloud
        model = skin_prior(evidence.images) if memory is None else memory.skin  # the face tells the tone
        skin = skin_probability(evidence.images, model)
        u, v = cloud.pixels.round().long().unbind(-1)
        p = skin.flatten(1).gather(1, v * skin.shape[2] + u)[..., None]
        return (self.share * p + (1 - self.share) * (1 - p)).log() * cloud.mask[..., None]


@torch.no_grad()
def measure(with_skin: bool, frames: int) -> tuple[float, float]:
    """Share of the points with the right part, and how far elbows and wrists are off, m."""
    made = make_recording("boxing", 0, 0, frames, synthetic_camera(320, 240, 10.0))
    recording, right, off = RenderedRecording(made), [], []
    model = tp.StereoToPose(made.camera, config=tp.PoseConfig(colour=ColourConfig(strength=0.0)))
    if with_skin:
        model.likelihoods.append(Skin(model.body.segment_names))
    model.prepare(recording)
    for position, frame in enumerate(recording):
        found = model.follow(frame)
        assert found.sight is not None and found.registration is not None  # noqa: PT018
        seen = found.sight.cloud.mask[0]
        u, v = found.sight.cloud.pixels[0, seen].round().long().unbind(-1)
        part = made.frames(position, position + 1).labels[0, v, u] - 1  # -1 beside the person
        right.append((found.registration.belief[0].argmax(0)[seen] == part)[part >= 0].float().mean())
        joints = model.body(found.registration.pose, model.size).joints[0]
        off.append((joints - made.joints[position])[5:9].norm(dim=-1).mean())
    return float(torch.stack(right).mean()), float(torch.stack(off).mean())


if __name__ == "__main__":
    torch.set_num_threads(1)  # two on busy cores are slower
    for name in ("without", "with Skin"):
        share, gap = measure(name == "with Skin", int(sys.argv[1]) if len(sys.argv) > 1 else 12)
        print(
            f"{name:10} {100 * share:5.1f} % of the points right, elbows and wrists {1000 * gap:4.0f} mm off"
        )

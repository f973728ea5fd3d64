"""A ninth activity: a few clips of it, a recogniser that knows nine, and its answers for people it has not seen.

python examples/new_activity.py
python examples/new_activity.py drinking runs/drink_1 runs/drink_2 runs/drink_3

The first makes all clips: the thesis's eight activities and waving, as poses with errors of 4 degrees, which takes no
time. The second takes the new activity's clips from folders that infer.py wrote; the last third of them tests. The
recogniser that is kept says who did what when: `python infer.py recording=my_day recognizer=runs/new_activity`.
"""

import sys
from pathlib import Path

import torch

import torchpose as tp
from torchpose.body.superquadric import draw_person
from torchpose.synthesis.database import synthetic_camera
from torchpose.synthesis.motion import ACTIVITIES, RIGHT, Draw, perform, pose_figure, stand_at_ease

TIMES, PEOPLE, NOISE = torch.arange(40) / 10, range(6), 0.07  # s, seeds of people, rad
BODY = tp.BodyModel()


def wave(take: int) -> torch.Tensor:
    """Poses (T, 24) of somebody who waves with the right hand."""
    draw, still = Draw("wave", take), 0 * TIMES
    figure, swing = stand_at_ease(draw, TIMES), (2 * torch.pi * draw(1.0, 1.6) * TIMES + draw(0, 6)).sin()
    figure.arms[RIGHT] = torch.stack([1.2 + still, 0.4 + still, 2.6 + still, 0.9 + 0.9 * swing])
    return pose_figure(BODY, figure, still)


def clip(activity: str, subject: int, pose: torch.Tensor) -> tp.Clip:
    """A clip as the pipeline would give it: poses with errors."""
    return tp.Clip(activity, str(subject), "0", pose=pose + NOISE * torch.randn_like(pose))


def main(name: str = "waving", *folders: str) -> None:
    torch.manual_seed(0)
    torch.set_num_threads(1)  # two on busy cores are slower
    sizes, camera = [draw_person(number).size(BODY) for number in PEOPLE], synthetic_camera()
    known = [clip(a, k, perform(BODY, sizes[k], a, TIMES, camera, k)) for a in ACTIVITIES for k in PEOPLE]
    runs = {folder: tp.read_poses_npz(Path(folder) / "poses.npz").pose for folder in folders}
    new = [tp.Clip(name, folder, "0", pose=pose.float()) for folder, pose in runs.items() if pose is not None]
    new = new or [clip(name, k, wave(k)) for k in PEOPLE]
    test = [one for one in known if int(one.subject) >= 4] + new[-max(1, len(new) // 3) :]
    train = [one for one in (*known, *new) if all(one is not other for other in test)]

    recognizer = tp.Recognizer().fit(train)
    found = recognizer(test)
    for one, answer, odds in zip(test, found.activity.tolist(), found.log_odds.tolist(), strict=True):
        named = recognizer.activities[answer] if answer >= 0 else "no answer"
        print(f"{one.activity:12} by {one.subject:8} -> {named:12} {odds:6.2f} nats a frame before the next")
    print(f"{100 * recognizer.evaluate(test).accuracy:.0f} % of {len(test)} clips right")
    recognizer.save("runs/new_activity")


if __name__ == "__main__":
    main(*sys.argv[1:])

"""Many recordings over several processes, and one table; one that fails does not stop the others.

python examples/batch.py day1 day2 day3 --output runs/batch --workers 2 -- max_frames=100 pose.height=1.80

What stands after `--` are settings of infer.py; other settings need another output folder. Run it again after an
interruption: finished recordings are kept, others go on where they stopped.
"""

import argparse
import csv
import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

INFER = Path(__file__).resolve().parents[1] / "infer.py"


def run(recording: str, output: Path, settings: list[str]) -> dict[str, object]:
    """One recording through infer.py, in a process of its own, with one thread."""
    summary = output / "summary.json"
    if not summary.is_file():
        output.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, str(INFER), f"recording={recording}", f"output={output}", *settings]
        one_thread = os.environ | {"OMP_NUM_THREADS": "1"}
        done = subprocess.run(command, capture_output=True, text=True, env=one_thread)
        (output / "log.txt").write_text(done.stdout + done.stderr)
        if done.returncode:
            message = (done.stderr.strip().splitlines() or ["no message"])[-1]
            return {"recording": recording, "problem": message.removeprefix("error: ")}
    found = json.loads(summary.read_text())
    row = {"recording": recording, "problem": "; ".join(found["problems"])}
    distance = found["point_to_model_m"]["mean"]  # null where nobody was found
    row |= {"point_to_model_mm": "" if distance is None else f"{1000 * distance:.1f}"}
    return row | {name: round(found[name], 3) for name in ("frames", "answered", "seconds")}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("recordings", nargs="+", help="folders or videos")
    parser.add_argument("--output", type=Path, default=Path("runs/batch"))
    parser.add_argument("--workers", type=int, default=2, help="processes; one for each idle core is good")
    end = sys.argv.index("--") if "--" in sys.argv else len(sys.argv)
    options, settings = parser.parse_args(sys.argv[1:end]), sys.argv[end + 1 :]
    outputs = [options.output / f"{i:03d}_{Path(name).name}" for i, name in enumerate(options.recordings)]
    with ThreadPoolExecutor(options.workers) as pool:  # the threads only wait for the processes
        given = zip(options.recordings, outputs, strict=True)
        rows = list(pool.map(lambda one: run(one[0], one[1], settings), given))
    with (options.output / "summary.csv").open("w", newline="") as file:
        names = ["recording", "frames", "answered", "point_to_model_mm", "seconds", "problem"]
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)
    print((options.output / "summary.csv").read_text())
    failed = sum("frames" not in row for row in rows)
    print(f"{len(rows) - failed} of {len(rows)} recordings done; the table is {options.output}/summary.csv")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())

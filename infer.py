"""Joint angles from a stereo or depth recording.

python infer.py                            # a recording that the package makes itself
python infer.py recording=DIR output=DIR   # yours
python infer.py --help                     # what there is to say and to set
"""

import sys

from torchpose.cli import infer_main

if __name__ == "__main__":
    sys.exit(infer_main(sys.argv[1:]))

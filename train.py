"""Train and score the activity recogniser.

python train.py                   # on a database that the package makes itself
python train.py experiment=NAME   # as configs/experiment/NAME.yaml says
python train.py --help            # what there is to say and to set
"""

import sys

from torchpose.cli import train_main

if __name__ == "__main__":
    sys.exit(train_main(sys.argv[1:]))

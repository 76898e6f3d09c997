"""The entry point of a checkout: `python train.py experiment=<name> [key=value ...]`.

It is `dolens train`.  Hydra's tab completion looks for the text @hydra.main in this file.
"""

import sys
from pathlib import Path

if __name__ == "__main__":
    here = Path(__file__).resolve().parent
    install = f'in {here} run: python -m pip install -c constraints.txt -e ".[train]"'
    try:
        from dolens.cli.train import run_training
    except ModuleNotFoundError as error:
        sys.exit(f"error: {error.name} is not installed for this Python; {install}")
    run_training(sys.argv[1:], sys.argv[0])

"""``python -m torchstickcal``"""

import sys

from torchstickcal.cli import program

sys.exit(program())

"""``python -m torchstickcal``"""

import sys

from torchstickcal.cli import main

sys.exit(main())

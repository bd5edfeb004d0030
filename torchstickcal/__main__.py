"""``python -m torchstickcal``"""

import signal
import sys

if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # until `program` hears Ctrl-C, it ends this process without a traceback

from torchstickcal.cli import program

sys.exit(program())

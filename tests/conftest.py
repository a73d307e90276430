import sys
from pathlib import Path

# `reference` (the plain twins of kernels) is shared by the tests of several rooms.
sys.path.insert(0, str(Path(__file__).parent))

"""Where the project and foreign data lie."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SOURCES = ROOT / "src"
EXAMPLES = ROOT / "examples"
#: Real captures, bags and odd files that nobody here made; tests skip where they are absent.
DATA = ROOT.parent / "shared" / "data"

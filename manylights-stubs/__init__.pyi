from collections.abc import Sequence

from comparison.images import write as write
from comparison.render import Took as Took
from comparison.render import render as render

def main(arguments: Sequence[str] | None = None) -> int: ...

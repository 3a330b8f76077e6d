"""python -m track_fusion.cli: the same as track-fusion."""

from track_fusion.cli import main

main()

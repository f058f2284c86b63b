"""`saltus track`: recordings in; tracks, identities, assignments, summary and report out."""

from saltus.run.command import Options, track_files, track_recording, write_tracks
from saltus.run.follow import Feeding
from saltus.run.setup import setup_files
from saltus.times import parse_time

__all__ = ["Feeding", "Options", "parse_time", "setup_files", "track_files", "track_recording", "write_tracks"]

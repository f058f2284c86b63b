"""`saltus track`: recordings in; tracks, identities, assignments, summary and report out."""

from saltus.run.command import parse_time, track_files, track_recording, write_tracks

__all__ = ["parse_time", "track_files", "track_recording", "write_tracks"]

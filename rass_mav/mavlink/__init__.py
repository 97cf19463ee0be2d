"""Everything MAVLink: frames, checksum, signing, identity, messages, telemetry.

pymavlink is imported here and nowhere else (in `dialect`), and of it only the generated dialect.
"""

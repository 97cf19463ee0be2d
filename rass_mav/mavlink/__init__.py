"""Everything about MAVLink: frames, checksum, signing, identity, messages, telemetry.

Only this package imports pymavlink (in `dialect`), and only its generated dialect.
"""

"""What the checksums of relayed messages cover. From `wire/table.py`, by tools/wire.py: do not edit."""

from struct import Struct

RECEIPT = Struct("<HIIB")
RECEIPT_ENTRY = Struct("<HI")
SEQUENCE_MARK = Struct("<HII")
SUMMARY = Struct("<HIIBBB")
DELETION_ENTRY = Struct("<HIIB")

"""Keys: what makes a mission's nodes known to each other, and its data readable for the ground alone
(docs/how-to/keys.md).

Only this package imports PyNaCl. A node without keys loads none of it except `settings`.
"""

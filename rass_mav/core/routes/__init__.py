"""The route to a base: neighbours, announcements, one routing table for hops and for costs."""

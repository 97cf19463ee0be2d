"""What has become of data: arrivals, receipts, losses."""

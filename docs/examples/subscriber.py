"""At the base: a line for each reading above a limit (uSv/h), as it arrives.

rass-mav ls base.yaml --follow --json | python3 subscriber.py 1.0
"""

import json
import sys

limit = float(sys.argv[1])
for line in sys.stdin:
    datum = json.loads(line)
    measured = datum.get("measurement")
    if measured is None or measured["unit"] != "usvh" or (measured["reading"] or 0.0) <= limit:
        continue
    drone = datum["id"].split("-")[0]
    where = "at an unknown place"
    if measured["latitude"] is not None:
        where = f"at {measured['latitude']:.6f} {measured['longitude']:.6f}"
    print(f"drone {drone}: {measured['reading']:g} uSv/h {where}, {datum.get('utc', 'at an unknown time')}", flush=True)

"""At the base: publishes each datum as rass/DRONE/KIND. Needs paho-mqtt 2 (the extra `mqtt`).

rass-mav ls base.yaml --follow --json | python3 mqtt_bridge.py broker.local:1883
"""

import json
import sys

import paho.mqtt.client as mqtt

host, _, port = sys.argv[1].partition(":")
client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
try:
    client.connect(host, int(port or 1883))
except OSError as error:
    sys.exit(f"{sys.argv[1]}: no broker: {error}")
client.loop_start()
for line in sys.stdin:
    datum = json.loads(line)
    drone = datum["id"].split("-")[0]
    # Waits for the broker's answer, if need be until the connection is back. The store is the queue meanwhile.
    client.publish(f"rass/{drone}/{datum['kind']}", line.strip(), qos=1).wait_for_publish()
client.disconnect()
client.loop_stop()

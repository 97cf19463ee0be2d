"""Which component a MAVLink message is for."""

from __future__ import annotations

#: As a target: every system, or every component of a system.
BROADCAST = 0
#: The component id of an autopilot.
AUTOPILOT_COMPONENT = 1


def addressed_to(target_system: int, target_component: int, system_id: int, component_id: int) -> bool:
    """Whether a message with this target is for the component `component_id` of the system `system_id`.

    A message to system 0 is for everybody, whatever its target component. A message to component 0 of a system is for
    all its components. Source: https://mavlink.io/en/guide/routing.html, except its last rule, which is about
    forwarding.
    """
    return target_system == BROADCAST or (target_system == system_id and target_component in (BROADCAST, component_id))

"""Settings of a node's MAVLink messages."""

from __future__ import annotations

from typing import Annotated

from rass_mav.config.sections import Meta, Section

from .identity import AUTOPILOT_COMPONENT


class MavlinkSettings(Section):
    """MAVLink ids and framing."""

    system_id: Annotated[int, Meta(ge=1, le=255)] | None = None
    """System id of the node; null: the autopilot's, and until that is heard one derived from the node id."""
    component_id: Annotated[int, Meta(ge=2, le=250)] = 191
    """Component id of the node; 1 belongs to the autopilot."""
    payload_type: Annotated[int, Meta(ge=0, le=65535)] = 33200
    """`payload_type` of the TUNNEL messages, the same in the whole swarm; values above 32767 are for local use."""
    autopilot_id: Annotated[int, Meta(ge=0, le=255)] = 0
    """System id of the autopilot whose readings and positions count; 0: the first one heard. Set it where other
    vehicles can be heard at the same port."""
    radio_system_id: Annotated[int, Meta(ge=1, le=255)] = 51
    """System id from which RADIO_STATUS counts on links without `radio`; SiK and RFD radios: 51."""
    radio_component_id: Annotated[int, Meta(ge=1, le=255)] = 68
    """Its component id; SiK and RFD radios: 68."""
    reading_name: Annotated[str, Meta(min_length=1, max_length=10)] = "RAD"
    """Name of the NAMED_VALUE_FLOAT with the reading."""
    reading_component: Annotated[int, Meta(ge=1, le=255)] = AUTOPILOT_COMPONENT
    """Component id of the vehicle's component that sends the reading; 1: the autopilot."""

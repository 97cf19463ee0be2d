"""Settings of a node's MAVLink messages."""

from __future__ import annotations

from typing import Annotated

from rass_mav.config.sections import Meta, Section

from .identity import AUTOPILOT_COMPONENT


class MavlinkSettings(Section):
    """Identity and framing."""

    system_id: Annotated[int, Meta(ge=1, le=255)] | None = None
    """MAVLink system id; null: the autopilot's. Until the autopilot is heard, derived from the node id."""
    component_id: Annotated[int, Meta(ge=2, le=250)] = 191
    """MAVLink component id of the node; 1 belongs to the autopilot."""
    payload_type: Annotated[int, Meta(ge=0, le=65535)] = 33200
    """payload_type of our TUNNEL frames; values above 32767 are for local use."""
    autopilot_id: Annotated[int, Meta(ge=0, le=255)] = 0
    """System id of the autopilot that provides readings and positions; 0: the first one heard."""
    radio_system_id: Annotated[int, Meta(ge=1, le=255)] = 51
    """System id with which a telemetry radio that no link's `radio` names sends its RADIO_STATUS; SiK and RFD: 51."""
    radio_component_id: Annotated[int, Meta(ge=1, le=255)] = 68
    """Component id with which it sends RADIO_STATUS; SiK and RFD: 68."""
    reading_name: Annotated[str, Meta(min_length=1, max_length=10)] = "RAD"
    """Name of the NAMED_VALUE_FLOAT that contains the reading."""
    reading_component: Annotated[int, Meta(ge=1, le=255)] = AUTOPILOT_COMPONENT
    """Component id of the vehicle's component that sends it; 1: the autopilot."""

-- Wireshark dissector for rass_mav: MAVLink 2 frames in UDP, TUNNEL (message 385) in them, and in it every field of our
-- own payloads (docs/reference/protocol.md). How to use it: tools/README.md.
--
-- Written for Lua 5.2 (Wireshark 4.0 and 4.2) and Lua 5.4 (from 4.4 on): no bit library, no integer division.

local TUNNEL_ID = 385
local TUNNEL_EXTRA = 147 -- CRC_EXTRA: a digest of the message's definition, goes into the checksum
local AHEAD_OF_DATA = 5 -- bytes of TUNNEL before its data: payload_type, target_system, target_component, length
local SIGNATURE_SIZE = 13

local frame = Proto("rass_mavlink", "MAVLink 2 (rass_mav)")
local rass = Proto("rass", "RASS swarm storage")

frame.prefs.payload_type = Pref.uint("payload_type", 33200, "mavlink.payload_type of the swarm")
frame.prefs.port = Pref.uint("UDP port", 14600, "Port of the nodes' links; frames of ours are found on other ports too")

-- Fields --------------------------------------------------------------------------------------------------------------

-- names: from the table of messages, by tools/generate_wire.py
local TYPES =
    { [1] = "Beacon", [2] = "Data", [3] = "Offer", [4] = "Accept", [5] = "Chunk", [6] = "Sack", [7] = "Committed", [8] = "Receipt", [9] = "Deletion report", [10] = "Put", [11] = "Query", [13] = "Copy statuses", [14] = "Sequence mark", [254] = "Introduction", [253] = "Statement signature", [252] = "Anchor", [251] = "Ask", [249] = "Key update", [248] = "Key request" }
local BLOCK_KINDS =
    { [1] = "answers", [2] = "a distant replica", [3] = "motion", [4] = "proof of the route", [5] = "tags of the answers", [6] = "key of the beacon", [7] = "key updates" }
local VERSION, MORE = 4, 15
-- end of names
local KINDS = {}
for kind, name in pairs({ [0] = "bytes", [1] = "measurement", [2] = "file", [3] = "status" }) do
    KINDS[kind], KINDS[kind + 64] = name, name .. " with terms"
    KINDS[kind + 128], KINDS[kind + 192] = "sealed " .. name, "sealed " .. name .. " with terms"
end
local REASONS = { [1] = "corrupted", [2] = "expired", [3] = "overflow", [4] = "died", [5] = "vanished",
    [6] = "numbers unknown from here on", [7] = "store damaged" }
local STATUSES = { [0] = "again", [1] = "none", [2] = "taken", [3] = "still", [4] = "wanted", [5] = "here", [6] = "enclosed", [7] = "passed_on" }
local UNITS = { "uSv/h", "cpm", "cps", "counts" }
local TARGETS = { [65535] = "everybody" }
local UPDATES = { [0] = "with a key", [1] = "revoked" }
local SEAL_SIZE = 16 -- bytes of the tag behind sealed contents
local TERMS_SIZE = 4
local TAG_SIZE = 8

local f = {}
local function field(key, make, abbreviation, ...)
    f[key] = make(abbreviation, ...)
end

field("length", ProtoField.uint8, "rass_mavlink.length", "Payload length")
field("incompatible", ProtoField.uint8, "rass_mavlink.incompatible", "Incompatibility flags", base.HEX)
field("signed", ProtoField.bool, "rass_mavlink.signed", "Signed")
field("mav_sequence", ProtoField.uint8, "rass_mavlink.sequence", "Sequence")
field("system", ProtoField.uint8, "rass_mavlink.system", "System id")
field("component", ProtoField.uint8, "rass_mavlink.component", "Component id")
field("message_id", ProtoField.uint24, "rass_mavlink.message_id", "Message id")
field("checksum", ProtoField.uint16, "rass_mavlink.checksum", "Checksum", base.HEX)
field("good", ProtoField.bool, "rass_mavlink.checksum_good", "Checksum good")
field("link_id", ProtoField.uint8, "rass_mavlink.signature_link", "Signature: link id")
field("ticks", ProtoField.uint64, "rass_mavlink.signature_timestamp", "Signature: timestamp, which counts the frames of the stream")
field("signature", ProtoField.bytes, "rass_mavlink.signature", "Signature")
field("payload_type", ProtoField.uint16, "rass_mavlink.payload_type", "TUNNEL payload type")
field("target_system", ProtoField.uint8, "rass_mavlink.target_system", "TUNNEL target system")
field("target_component", ProtoField.uint8, "rass_mavlink.target_component", "TUNNEL target component")
field("payload_length", ProtoField.uint8, "rass_mavlink.payload_length", "TUNNEL payload length")
frame.fields = f

local g = f -- those of the frame; f is for our own messages
f = {}
field("version", ProtoField.uint8, "rass.version", "Version", base.DEC, nil, 0xf0)
field("type", ProtoField.uint8, "rass.type", "Type", base.DEC, TYPES, 0x0f)
field("more", ProtoField.uint8, "rass.type_more", "Type", base.DEC, TYPES)
-- fields: from the table of messages, by tools/generate_wire.py
field("sender", ProtoField.uint16, "rass.sender", "Sender")
field("life", ProtoField.uint32, "rass.life", "Life: of the sender", base.HEX)
field("beacon", ProtoField.uint16, "rass.beacon", "Beacon number: compared by RFC 1982; starts anywhere")
field("flags", ProtoField.uint8, "rass.flags", "Flags", base.HEX)
field("base", ProtoField.uint16, "rass.base", "Base")
field("base_life", ProtoField.uint32, "rass.base_life", "Base life", base.HEX)
field("route_number", ProtoField.uint16, "rass.route_number", "Announcement number")
field("hops", ProtoField.uint8, "rass.hops", "Hops: sender to base, 0..254; 255: no route")
field("wanted_base", ProtoField.uint16, "rass.wanted_base", "Wanted base")
field("wanted_number", ProtoField.uint16, "rass.wanted_number", "Wanted number")
field("risk", ProtoField.uint16, "rass.risk", "Risk: 0..65535 for 0..1")
field("free", ProtoField.uint16, "rass.free", "Free")
field("policy", ProtoField.uint16, "rass.policy", "Policy tag: potentials of different tags cannot be compared",
    base.HEX)
field("potential", ProtoField.uint32, "rass.potential",
    "Potential: 2^24 is fitness 1; 4294967295: a base; 0: no room")
field("statements_hash", ProtoField.uint32, "rass.statements_hash", "Statements hash", base.HEX)
field("beacon_crc", ProtoField.uint32, "rass.beacon_crc", "CRC: CRC-32 of bytes 0 to 36, and then 41 to the end",
    base.HEX)
field("turn", ProtoField.uint16, "rass.turn", "Turn")
field("target", ProtoField.uint16, "rass.target", "Target", base.DEC, TARGETS)
field("count", ProtoField.uint8, "rass.count", "Count", base.DEC, nil, 0x7f)
field("number", ProtoField.uint32, "rass.number", "Hand-over number", base.HEX)
field("origin", ProtoField.uint16, "rass.origin", "Origin")
field("epoch", ProtoField.uint32, "rass.epoch", "Epoch", base.HEX)
field("sequence", ProtoField.uint32, "rass.sequence", "Sequence")
field("age", ProtoField.uint32, "rass.age", "Age: ms", base.DEC, nil, 0x7fffffff)
field("datum_hops", ProtoField.uint8, "rass.datum_hops", "Hops: hand-overs so far; the receiver adds one")
field("kind", ProtoField.uint8, "rass.kind", "Kind", base.DEC, KINDS)
field("crc", ProtoField.uint32, "rass.crc", "CRC", base.HEX)
field("size", ProtoField.uint8, "rass.size", "Size")
field("size_2", ProtoField.uint32, "rass.size", "Size: bytes, 1..1048576; more is refused")
field("chunk_size", ProtoField.uint8, "rass.chunk_size", "Chunk size: 1..123")
field("handle", ProtoField.uint16, "rass.handle", "Handle", base.HEX)
field("next_index", ProtoField.uint16, "rass.next_index", "Next index")
field("position", ProtoField.uint16, "rass.position", "Index", base.DEC, nil, 0x7fff)
field("data", ProtoField.bytes, "rass.data", "Data")
field("question", ProtoField.uint16, "rass.question", "Question")
field("count_2", ProtoField.uint8, "rass.count", "Count")
field("committed", ProtoField.uint8, "rass.committed", "Committed: number of pairs")
field("refused", ProtoField.uint8, "rass.refused", "Refused: number of numbers")
field("refused_number", ProtoField.uint32, "rass.refused_number", "Hand-over number", base.HEX)
field("serial", ProtoField.uint32, "rass.serial", "Serial")
field("reason", ProtoField.uint8, "rass.reason", "Reason", base.DEC, REASONS)
field("report_proof", ProtoField.bytes, "rass.report_proof", "Proof: only with bit 7 of the count")
field("lamport", ProtoField.uint16, "rass.lamport", "Lamport timestamp: from 1")
field("writer", ProtoField.uint16, "rass.writer", "Writer: node id of the last writer")
field("status", ProtoField.uint8, "rass.status", "Status", base.DEC, STATUSES)
field("assigned", ProtoField.uint32, "rass.assigned", "Assigned")
field("introduction.flags", ProtoField.uint8, "rass.introduction.flags", "Flags", base.HEX)
field("asked", ProtoField.uint8, "rass.asked", "Asked")
field("proofs", ProtoField.uint8, "rass.proofs", "Proofs")
field("nonce", ProtoField.uint64, "rass.nonce", "Nonce", base.HEX)
field("node_id", ProtoField.uint16, "rass.node_id", "Node id")
field("place", ProtoField.uint64, "rass.place", "Place: the sender's last one", base.HEX)
field("introduction.beacon", ProtoField.uint32, "rass.introduction.beacon", "Index: of the sender's last beacon")
field("key", ProtoField.bytes, "rass.key", "Key")
field("introduction.next_end", ProtoField.bytes, "rass.introduction.next_end",
    "Next end: of the sender's next chain of keys")
field("tag", ProtoField.bytes, "rass.tag", "Tag")
field("first_serial", ProtoField.uint32, "rass.first_serial", "First")
field("salt", ProtoField.uint32, "rass.salt", "Salt: drawn at random by the base when it signs", base.HEX)
field("hash", ProtoField.bytes, "rass.hash", "Hash")
field("signature", ProtoField.bytes, "rass.signature", "Signature")
field("chain", ProtoField.uint32, "rass.chain", "Serial")
field("first_number", ProtoField.uint16, "rass.first_number", "First: the first announcement number of the chain")
field("anchor", ProtoField.bytes, "rass.anchor", "Anchor")
field("bases", ProtoField.uint8, "rass.bases", "Bases: whose anchors are lacking, at most 4")
field("statements", ProtoField.uint8, "rass.statements",
    "Statements: whose statement signatures are lacking, at most 9")
field("update.flags", ProtoField.uint8, "rass.update.flags",
    "Flags: 0: with a key; 1: revoked; others are malformed", base.DEC, UPDATES)
field("link_key", ProtoField.uint32, "rass.link_key", "Number")
field("node_serial", ProtoField.uint32, "rass.node_serial", "Serial")
field("sealed_key", ProtoField.bytes, "rass.sealed_key", "Sealed key: for the drone alone")
field("near", ProtoField.uint16, "rass.near", "Near: the node that the sender keeps its replica for")
field("custodian", ProtoField.uint16, "rass.custodian", "Custodian: the node with custody")
field("further", ProtoField.uint8, "rass.further", "Further: how many more nodes should have a copy")
field("moves", ProtoField.uint64, "rass.moves", "Motion", base.HEX)
field("proof", ProtoField.bytes, "rass.proof", "Proof: element of the hash chain")
field("updates", ProtoField.uint32, "rass.updates", "Key updates", base.HEX)
field("flags.base", ProtoField.bool, "rass.flags.base", "Base", 8, nil, 0x1)
field("flags.wanted", ProtoField.bool, "rass.flags.wanted", "Wanted", 8, nil, 0x2)
field("replica", ProtoField.bool, "rass.replica", "Replica", 8, nil, 0x80)
field("at_least", ProtoField.bool, "rass.at_least", "At least", 32, nil, 0x80000000)
field("poll", ProtoField.bool, "rass.poll", "Poll", 16, nil, 0x8000)
field("proven", ProtoField.bool, "rass.proven", "Proven", 8, nil, 0x80)
field("introduction.flags.certificate", ProtoField.bool, "rass.introduction.flags.certificate", "Certificate", 8,
    nil, 0x1)
field("introduction.flags.wanted", ProtoField.bool, "rass.introduction.flags.wanted", "Wanted", 8, nil, 0x2)
-- end of fields
field("payload", ProtoField.bytes, "rass.payload", "Payload of the datum")
field("priority", ProtoField.uint8, "rass.priority", "Priority")
field("lifetime", ProtoField.uint24, "rass.lifetime", "Lifetime, s; 0: none")
field("bitmap_size", ProtoField.uint8, "rass.bitmap_size", "Bytes of bitmap")
field("bitmap", ProtoField.bytes, "rass.bitmap", "Bitmap")
field("block", ProtoField.uint8, "rass.block", "Kind of block", base.DEC, BLOCK_KINDS)
field("block_size", ProtoField.uint8, "rass.block_size", "Bytes in the block")
field("block_content", ProtoField.bytes, "rass.block_content", "Content of the block")
field("first", ProtoField.uint32, "rass.first", "First sequence")
field("run", ProtoField.uint32, "rass.run", "Sequences that follow each other")
field("entry_size", ProtoField.uint8, "rass.entry_size", "Bytes of bitmap", base.DEC, nil, 0x7f)
field("lost", ProtoField.bool, "rass.lost", "Told lost", 8, nil, 0x80)
field("entry_bitmap", ProtoField.bytes, "rass.entry_bitmap", "Bitmap: first + run + i too")
field("mark", ProtoField.uint32, "rass.mark", "Mark")
field("m_version", ProtoField.uint8, "rass.measurement.version", "Version")
field("m_flags", ProtoField.uint8, "rass.measurement.flags", "Flags", base.HEX)
field("m_place_1", ProtoField.int32, "rass.measurement.latitude", "Latitude, 1e-7 degrees (local: north, mm)")
field("m_place_2", ProtoField.int32, "rass.measurement.longitude", "Longitude, 1e-7 degrees (local: east, mm)")
field("m_place_3", ProtoField.int32, "rass.measurement.altitude", "Altitude, mm (local: down)")
field("m_reading", ProtoField.float, "rass.measurement.reading", "Reading, the sensor's own unit")
field("m_risk", ProtoField.uint16, "rass.measurement.risk", "Risk (65535 is 1)")
field("m_unit", ProtoField.uint8, "rass.measurement.unit", "Unit of the reading", base.DEC, UNITS)
field("m_error", ProtoField.uint16, "rass.measurement.error", "Error of the position at most, dm")
field("sealed", ProtoField.bytes, "rass.sealed", "Sealed contents")
field("seal", ProtoField.bytes, "rass.seal", "Tag of the sealed contents")
field("public_key", ProtoField.bytes, "rass.public_key", "Public key")
field("s_version", ProtoField.uint8, "rass.status.version", "Version")
field("s_flags", ProtoField.uint8, "rass.status.flags", "Flags", base.HEX)
field("s_held", ProtoField.uint16, "rass.status.held", "Data in custody")
field("s_alone", ProtoField.uint16, "rass.status.alone", "Of which no other node keeps a copy")
field("s_spares", ProtoField.uint16, "rass.status.spares", "Replicas kept for others")
field("s_free", ProtoField.uint16, "rass.status.free", "Data for which there is space (65535: no limit)")
field("s_risk", ProtoField.uint16, "rass.status.risk", "Risk (65535 is 1)")
field("s_hops", ProtoField.uint8, "rass.status.hops", "Hops to a base (255: no route)")
field("s_battery", ProtoField.uint8, "rass.status.battery", "Battery, percent (above 100: unknown)")
field("s_latitude", ProtoField.int32, "rass.status.latitude", "Latitude, 1e-7 degrees")
field("s_longitude", ProtoField.int32, "rass.status.longitude", "Longitude, 1e-7 degrees")
field("s_neighbours", ProtoField.uint8, "rass.status.neighbours", "Neighbours")
field("s_neighbour", ProtoField.uint16, "rass.status.neighbour", "Neighbour")
field("s_share", ProtoField.uint8, "rass.status.share", "Share of its beacons that are heard (255 is 1)")
field("s_origins", ProtoField.uint8, "rass.status.origins", "Origins")
field("s_origin", ProtoField.uint16, "rass.status.origin", "Origin")
field("s_created", ProtoField.uint16, "rass.status.created", "Of the data without a copy it created")
field("s_link_key", ProtoField.uint32, "rass.status.link_key", "Number of the link key")
rass.fields = f

local malformed = ProtoExpert.new("rass.malformed", "Cut off, fields contradict each other, or a wrong checksum",
    expert.group.MALFORMED, expert.severity.ERROR)
local foreign = ProtoExpert.new("rass.foreign", "Another version, or a type that is not known",
    expert.group.UNDECODED, expert.severity.NOTE)
rass.experts = { malformed, foreign }
local bad_checksum = ProtoExpert.new("rass_mavlink.bad_checksum", "Bad checksum", expert.group.CHECKSUM,
    expert.severity.ERROR)
frame.experts = { bad_checksum }

-- Checksums -----------------------------------------------------------------------------------------------------------

-- Exclusive or of two bytes, from a table of half bytes: which bit library there is depends on the Lua.
local HALF = {}
for a = 0, 15 do
    HALF[a] = {}
    for b = 0, 15 do
        local sum, bit = 0, 1
        for _ = 1, 4 do
            if math.floor(a / bit) % 2 ~= math.floor(b / bit) % 2 then sum = sum + bit end
            bit = bit * 2
        end
        HALF[a][b] = sum
    end
end

local function xor(a, b)
    local a_low, b_low = a % 16, b % 16
    return HALF[(a - a_low) / 16][(b - b_low) / 16] * 16 + HALF[a_low][b_low]
end

-- CRC-16/MCRF4XX of each byte: low and high half.
local LOW, HIGH = {}, {}
for byte = 0, 255 do
    local low, high = byte, 0
    for _ = 1, 8 do
        local carry = low % 2
        low = (low - carry) / 2 + high % 2 * 128
        high = (high - high % 2) / 2
        if carry == 1 then low, high = xor(low, 0x08), xor(high, 0x84) end
    end
    LOW[byte], HIGH[byte] = low, high
end

local function checksum(tvb, first, last, extra)
    local low, high = 0xff, 0xff
    local function feed(byte)
        local index = xor(low, byte)
        low, high = xor(high, LOW[index]), HIGH[index]
    end
    for at = first, last do feed(tvb(at, 1):uint()) end
    feed(extra)
    return low + high * 256
end

-- CRC-32 (as zlib) of each byte: four bytes, the lowest first.
local CRC_32 = {}
for byte = 0, 255 do
    local crc = { byte, 0, 0, 0 }
    for _ = 1, 8 do
        local carry = crc[1] % 2
        for i = 1, 4 do crc[i] = (crc[i] - crc[i] % 2) / 2 + (i < 4 and crc[i + 1] % 2 * 128 or 0) end
        if carry == 1 then
            crc = { xor(crc[1], 0x20), xor(crc[2], 0x83), xor(crc[3], 0xb8), xor(crc[4], 0xed) }
        end
    end
    CRC_32[byte] = crc
end

-- CRC-32 of a message but for `size` bytes from `gap` on.
local function crc_32_around(tvb, gap, size)
    local a, b, c, d = 0xff, 0xff, 0xff, 0xff
    for at = 0, tvb:len() - 1 do
        if at < gap or at >= gap + size then
            local step = CRC_32[xor(a, tvb(at, 1):uint())]
            a, b, c, d = xor(b, step[1]), xor(c, step[2]), xor(d, step[3]), step[4]
        end
    end
    return 255 - a + (255 - b) * 256 + (255 - c) * 65536 + (255 - d) * 16777216
end

-- Our messages --------------------------------------------------------------------------------------------------------

-- Reads the fields of one message in turn. Everything that does not fit stops it with `CUT`.
local CUT = {}
local Reader = {}
Reader.__index = Reader

function Reader:need(size)
    if self.at + size > self.tvb:len() then error(CUT, 0) end
    local range = self.tvb(self.at, size)
    self.at = self.at + size
    return range
end

-- A little-endian number into the tree; returns it.
function Reader:number(key, size)
    local range = self:need(size)
    self.tree:add_le(f[key], range)
    return range:le_uint()
end

-- A little-endian number of more than four bytes into the tree.
function Reader:wide(key, size)
    self.tree:add_le(f[key], self:need(size))
end

function Reader:left()
    return self.tvb:len() - self.at
end

function Reader:bytes(key, size)
    local range = self:need(size)
    if size > 0 then self.tree:add(f[key], range) end
    return range
end

-- A branch of the tree around what `read` reads.
function Reader:branch(title, read)
    local start, parent = self.at, self.tree
    self.tree = parent:add(rass, self.tvb(start), title)
    read()
    self.tree:set_len(self.at - start)
    self.tree = parent
end

local function measurement(r, range)
    if range:len() < 20 or range(0, 1):uint() ~= 1 then return end
    local flags = range(1, 1):uint()
    local unit = math.floor(flags / 8) % 2
    local size = 20 + unit + math.floor(flags / 16) % 2 * 2
    if range:len() < size then return end
    local inner = r.tree:add(rass, range(0, size), "Measurement")
    inner:add(f.m_version, range(0, 1))
    inner:add(f.m_flags, range(1, 1))
    for i = 1, 3 do inner:add_le(f["m_place_" .. i], range(4 * i - 2, 4)) end
    inner:add_le(f.m_reading, range(14, 4))
    inner:add_le(f.m_risk, range(18, 2))
    if unit == 1 then inner:add(f.m_unit, range(20, 1)) end
    if size >= 22 then inner:add_le(f.m_error, range(20 + unit, 2)) end
end

-- What a node says about itself. What does not fit is left out.
local function status(r, range)
    local at, inner = 0, r.tree:add(rass, range, "Status")
    local function take(key, size)
        if at + size > range:len() then error(CUT, 0) end
        local part = range(at, size)
        inner:add_le(f[key], part)
        at = at + size
        return part:le_uint()
    end
    local function rows(count, first, size, second, other)
        for _ = 1, count do
            take(first, size)
            take(second, other)
        end
    end
    if range(0, 1):uint() ~= 1 then return end
    local whole, result = pcall(function()
        take("s_version", 1)
        local flags = take("s_flags", 1)
        for _, key in ipairs({ "s_held", "s_alone", "s_spares", "s_free", "s_risk" }) do take(key, 2) end
        take("s_hops", 1)
        take("s_battery", 1)
        take("s_latitude", 4)
        take("s_longitude", 4)
        rows(take("s_neighbours", 1), "s_neighbour", 2, "s_share", 1)
        rows(take("s_origins", 1), "s_origin", 2, "s_created", 2)
        if math.floor(flags / 8) % 2 == 1 then take("s_link_key", 4) end
    end)
    if not whole and result ~= CUT then error(result, 0) end
end

-- What layouts leave to functions, by name: each reads on, and may look at the values that have been read.
local HOOKS = {}

function HOOKS.datum_payload(r, v)
    local kind, size = v.kind, v.size
    if size == 0 then error(CUT, 0) end
    local payload = r:bytes("payload", size)
    if kind % 128 >= 64 and size > TERMS_SIZE then
        r.tree:add(f.priority, payload(0, 1))
        r.tree:add_le(f.lifetime, payload(1, 3))
        kind, size, payload = kind - 64, size - TERMS_SIZE, payload(TERMS_SIZE)
    end
    if kind == 1 then measurement(r, payload) end
    if kind == 3 then status(r, payload) end
    if kind >= 128 and size >= SEAL_SIZE then
        if size > SEAL_SIZE then r.tree:add(f.sealed, payload(0, size - SEAL_SIZE)) end
        r.tree:add(f.seal, payload(size - SEAL_SIZE, SEAL_SIZE))
    end
end

local function times(r, count, title, read)
    for i = 1, count do
        r:branch(string.format("%s %d", title, i), read)
    end
end

local LAYOUTS, BLOCKS = {}, {}
-- layouts: from the table of messages, by tools/generate_wire.py
LAYOUTS[1] = { { "sender", 2 }, { "life", 4 }, { "beacon", 2, name = "number" }, { "flags", 1, flags =
    { "flags.base", 0x1, "flags.wanted", 0x2 } }, { "base", 2 }, { "base_life", 4 }, { "route_number", 2 },
    { "hops", 1 }, { "wanted_base", 2 }, { "wanted_number", 2 }, { "risk", 2 }, { "free", 2 }, { "policy", 2 },
    { "potential", 4 }, { "statements_hash", 4 }, { "beacon_crc", 4, name = "crc" }, { "turn", 2 }, { hook = "blocks" }
    }
LAYOUTS[2] = { { "sender", 2 }, { "target", 2 }, { "count", 1, flags = { "replica", 0x80 }, hidden = 0x80 }, { rows
    = "count", title = "Hand-over", { { "number", 4 }, { "origin", 2 }, { "epoch", 4 }, { "sequence", 4 }, { "age", 4,
    flags = { "at_least", 0x80000000 }, hidden = 0x80000000 }, { "datum_hops", 1, name = "hops" }, { "kind", 1 },
    { "crc", 4 }, { "size", 1 }, { hook = "datum_payload" } } }, { hook = "blocks" } }
LAYOUTS[3] = { { "sender", 2 }, { "target", 2 }, { "number", 4 }, { "origin", 2 }, { "epoch", 4 },
    { "sequence", 4 }, { "age", 4, flags = { "at_least", 0x80000000 }, hidden = 0x80000000 },
    { "datum_hops", 1, name = "hops" }, { "kind", 1 }, { "crc", 4 }, { "size_2", 4, name = "size", least = 1 },
    { "chunk_size", 1, least = 1, most = 123 } }
LAYOUTS[4] = { { "sender", 2 }, { "target", 2 }, { "number", 4 }, { "handle", 2 }, { "next_index", 2 },
    { bitmap = 32 } }
LAYOUTS[5] = { { "handle", 2 }, { "position", 2, flags = { "poll", 0x8000 }, hidden = 0x8000 },
    { "data", rest = true } }
LAYOUTS[6] = { { "sender", 2 }, { "target", 2 }, { "handle", 2 }, { "next_index", 2 }, { bitmap = 32 },
    { "question", 2 }, { "count_2", 1, name = "count" }, { rows = "count", title = "Transfer", { { "handle", 2 },
    { "next_index", 2 }, { bitmap = 16 } }, most = 3 } }
LAYOUTS[7] = { { "sender", 2 }, { "target", 2 }, { "committed", 1 }, { "refused", 1 }, { rows = "committed", title =
    "Pair", { { "number", 4 }, { "crc", 4 } } }, { rows = "refused", title = "Refused", {
    { "refused_number", 4, name = "number" } } } }
LAYOUTS[8] = { { "base", 2 }, { "base_life", 4 }, { "serial", 4 }, { "crc", 4 }, { "count_2", 1, name = "count" }, {
    rows = "count", title = "Entry", { { "origin", 2 }, { "epoch", 4 }, { hook = "receipt_entry" } } } }
LAYOUTS[9] = { { "sender", 2 }, { "target", 2 }, { "count", 1, flags = { "proven", 0x80 }, hidden = 0x80 }, { rows =
    "count", title = "Loss", { { "number", 4 }, { "origin", 2 }, { "epoch", 4 }, { "sequence", 4 }, { "reason", 1 },
    { "crc", 4 } }, flag = "proven", last = { "report_proof", 10, name = "proof", bytes = true } } }
LAYOUTS[10] = { { "sender", 2 }, { "lamport", 2 }, { "writer", 2 }, { "origin", 2 }, { "epoch", 4 },
    { "sequence", 4 }, { "age", 4, flags = { "at_least", 0x80000000 }, hidden = 0x80000000 },
    { "datum_hops", 1, name = "hops" }, { "kind", 1 }, { "crc", 4 }, { "size", 1 }, { hook = "datum_payload" } }
LAYOUTS[11] = { { "sender", 2 }, { "target", 2 }, { "count_2", 1, name = "count" }, { rows = "count", title = "Key",
    { { "origin", 2 }, { "epoch", 4 }, { "sequence", 4 } }, most = 12 } }
LAYOUTS[13] = { { "sender", 2 }, { "target", 2 }, { "count_2", 1, name = "count" }, { rows = "count", title =
    "Datum", { { "origin", 2 }, { "epoch", 4 }, { "sequence", 4 }, { "status", 1 } } }, { hook = "place_and_tag" } }
LAYOUTS[14] = { { "origin", 2 }, { "epoch", 4 }, { "assigned", 4 }, { "crc", 4 } }
LAYOUTS[254] = { { "sender", 2 }, { "introduction.flags", 1, name = "flags", flags =
    { "introduction.flags.certificate", 0x1, "introduction.flags.wanted", 0x2 } }, { "asked", 1 }, { "proofs", 1 }, {
    when = "introduction.flags.certificate", { { hook = "certificate" } } }, { when = "asked", { { "nonce", 8 }, { rows
    = "asked", title = "Node", { { "node_id", 2 } } } } }, { when = "proofs", { { "place", 8 },
    { "introduction.beacon", 4, name = "index" }, { "key", 8, bytes = true },
    { "introduction.next_end", 8, name = "next_end", bytes = true }, { rows = "proofs", title = "Proof", {
    { "node_id", 2 }, { "tag", 8, bytes = true } } } } } }
LAYOUTS[253] = { { "base", 2 }, { "base_life", 4 }, { "first_serial", 4, name = "first" }, { "salt", 4 },
    { "count_2", 1, name = "count", least = 1, most = 5 }, { rows = "count", title = "Hash", {
    { "hash", 8, bytes = true } } }, { "signature", 64, bytes = true } }
LAYOUTS[252] = { { "base", 2 }, { "base_life", 4 }, { "chain", 4, name = "serial" },
    { "first_number", 2, name = "first" }, { "anchor", 8, name = "element", bytes = true },
    { "signature", 64, bytes = true } }
LAYOUTS[251] = { { "bases", 1, name = "base_count" }, { "statements", 1, name = "statement_count" }, { rows =
    "base_count", title = "Base", { { "base", 2 }, { "base_life", 4 } }, most = 4 }, { rows = "statement_count", title =
    "Statement", { { "base", 2 }, { "base_life", 4 }, { "serial", 4 } }, most = 9 } }
LAYOUTS[249] = { { "update.flags", 1, name = "flags", most = 1 }, { "link_key", 4, name = "number" },
    { "node_id", 2 }, { "node_serial", 4, name = "serial" }, { when = "flags", { { "sealed_key", 48, bytes = true } },
    unless = true }, { "signature", 64, bytes = true } }
LAYOUTS[248] = { { "node_id", 2 }, { "node_serial", 4, name = "serial" }, { "link_key", 4, name = "number" } }
BLOCKS[1] = { least = 4, again = true, { { "target", 2 }, { "committed", 1 }, { "refused", 1 }, { rows =
    "committed", title = "Pair", { { "number", 4 }, { "crc", 4 } } }, { rows = "refused", title = "Refused", {
    { "refused_number", 4, name = "number" } } } } }
BLOCKS[2] = { least = 5, { { "near", 2 }, { "custodian", 2 }, { "further", 1 } } }
BLOCKS[3] = { least = 8, { { "moves", 8 } } }
BLOCKS[4] = { least = 8, { { "proof", 8, bytes = true } } }
BLOCKS[5] = { least = 0, { { hook = "tags" } } }
BLOCKS[6] = { least = 8, { { "key", 8, bytes = true } } }
BLOCKS[7] = { least = 4, { { "updates", 4 } } }
-- end of layouts

local function one_field(r, step, v)
    local key, size = step[1], step[2]
    if step.rest then
        v.rest = r:left()
        r:bytes(key, v.rest)
        return
    end
    local range = r:need(size)
    if size > 4 then -- A wide number, or bytes: nothing depends on them.
        if step.bytes then r.tree:add(f[key], range) else r.tree:add_le(f[key], range) end
        return
    end
    local branch, value = r.tree:add_le(f[key], range), range:le_uint()
    local flags = step.flags or {}
    for i = 1, #flags, 2 do
        branch:add_le(f[flags[i]], range)
        v[flags[i]] = math.floor(value / flags[i + 1]) % 2
    end
    if step.hidden then value = value % step.hidden end -- It is the highest bit, or nothing depends on the value.
    if value < (step.least or 0) or value > (step.most or value) then error(CUT, 0) end
    v[step.name or key] = value
end

-- Reads what a layout says; returns the values of its fields, and lists of those of its rows.
local function read_layout(r, layout, v)
    v = v or {}
    for _, step in ipairs(layout) do
        if step.hook then
            HOOKS[step.hook](r, v)
        elseif step.when then
            if (v[step.when] == 0) == (step.unless or false) then read_layout(r, step[1], v) end
        elseif step.bitmap then
            local size = r:number("bitmap_size", 1)
            if size > step.bitmap then error(CUT, 0) end
            r:bytes("bitmap", size)
        elseif step.rows then
            local rows, count = {}, v[step.rows]
            if count > (step.most or count) then error(CUT, 0) end
            times(r, count, step.title, function()
                local row = read_layout(r, step[1])
                if step.flag and v[step.flag] == 1 then one_field(r, step.last, row) end
                rows[#rows + 1] = row
            end)
            v.rows = rows
        else
            one_field(r, step, v)
        end
    end
    return v
end

function HOOKS.tags(r)
    while r.at + TAG_SIZE <= r.last do r:bytes("tag", TAG_SIZE) end
end

-- What follows the fields of a beacon and the hand-overs of data, up to the end.
function HOOKS.blocks(r)
    while r:left() > 0 do
        r:branch("Block", function()
            local kind = r:number("block", 1)
            local size = r:number("block_size", 1)
            local block = BLOCKS[kind]
            r.last = r.at + size
            if r.last > r.tvb:len() then error(CUT, 0) end
            if block and block.again then
                while r.at < r.last do r:branch("Answer", function() read_layout(r, block[1]) end) end
                if r.at > r.last then error(CUT, 0) end
            elseif block and size >= block.least then
                read_layout(r, block[1])
            end
            if r.at < r.last then r:bytes("block_content", r.last - r.at) end
        end)
    end
end

-- The place of a statement about copies to one node, and its tag.
function HOOKS.place_and_tag(r)
    if r:left() < 4 then return end
    r:wide("place", 4)
    HOOKS.tag(r)
end

-- The tag behind an answer or a statement about a copy, if there is one.
function HOOKS.tag(r)
    if r:left() > 0 then r:bytes("tag", math.min(r:left(), TAG_SIZE)) end
end

-- A number of at most five bytes, seven bits in each, the low ones first.
local function varint(r, key)
    local from, number = r.at, 0
    for i = 0, 4 do
        local byte = r:need(1):uint()
        number = number + byte % 128 * 128 ^ i
        if byte < 128 then
            if byte == 0 and i > 0 or number >= 2 ^ 32 then error(CUT, 0) end
            r.tree:add(f[key], r.tvb(from, r.at - from), number)
            return number
        end
    end
    error(CUT, 0)
end

-- How many bits the highest byte of a bitmap takes.
local function bits_of(byte)
    local bits = 0
    while byte > 0 do
        byte = math.floor(byte / 2)
        bits = bits + 1
    end
    return bits
end

function HOOKS.receipt_entry(r)
    local ends = varint(r, "first")
    local run = varint(r, "run")
    local about = r:need(1)
    r.tree:add(f.entry_size, about)
    r.tree:add(f.lost, about)
    local size = about:uint() % 128
    if size > 16 or run == 0 then error(CUT, 0) end
    ends = ends + run
    if size > 0 then
        local bitmap = r:need(size)
        local last = bitmap(size - 1, 1):uint()
        if last == 0 or bitmap(0, 1):uint() % 2 == 1 then error(CUT, 0) end
        r.tree:add(f.entry_bitmap, bitmap)
        ends = ends + 8 * (size - 1) + bits_of(last)
    end
    if ends > 2 ^ 32 then error(CUT, 0) end
end

-- What stands in the packet list, by type; and what else may be wrong with a message.
local INFO = {}

function HOOKS.certificate(r)
    r:branch("Certificate", function()
        r:number("node_id", 2)
        r:number("node_serial", 4)
        r:bytes("public_key", 32)
        r:bytes("signature", 64)
    end)
end

local function ids(rows)
    local found = ""
    for _, v in ipairs(rows) do
        local status = v.status and (STATUSES[v.status] or tostring(v.status)) .. " " or ""
        found = string.format("%s %s%d-%08x-%d", found, status, v.origin, v.epoch, v.sequence)
    end
    return found
end

INFO[1] = function(v, r)
    if v.sender == 65535 or v.crc ~= crc_32_around(r.tvb, 37, 4) then error(CUT, 0) end
    local way = v.hops == 255 and "no route" or string.format("%d hops to %d", v.hops, v.base)
    return string.format(": %s, risk %.3f", way, v.risk / 65535)
end
INFO[2] = function(v) return (v.replica == 1 and ", replicas" or "") .. ids(v.rows) end
INFO[3] = function(v) return string.format("%s, %d bytes", ids({ v }), v.size) end
INFO[4] = function(v) return string.format(" %04x, from chunk %d on", v.handle, v.next_index) end
INFO[5] = function(v)
    if v.rest == 0 then return string.format("%04x, question %d", v.handle, v.position) end
    return string.format("%04x, chunk %d, %d bytes", v.handle, v.position, v.rest)
end
INFO[6] = function(v) return string.format(" %04x, all below chunk %d", v.handle, v.next_index) end
INFO[7] = function(v, r)
    HOOKS.tag(r)
    return string.format(", %d committed, %d refused", v.committed, v.refused)
end
INFO[8] = function(v) return string.format("base %d, %d entries", v.base, v.count) end
INFO[10] = function(v) return ":" .. ids({ v }) end
INFO[14] = function(v) return string.format("%d has assigned %d", v.origin, v.assigned) end

INFO[248] = function(v)
    return string.format("%d has link key %d, names %d key updates", v.node_id, v.number, v.count)
end
INFO[249] = function(v) return string.format("link key %d, drone %d %s", v.number, v.node_id, UPDATES[v.flags]) end
INFO[251] = function(v)
    return string.format("lacks %d anchors, %d statement signatures", v.base_count, v.statement_count)
end
INFO[252] = function(v) return string.format("base %d, chain %d from number %d on", v.base, v.serial, v.first) end
INFO[253] = function(v) return string.format("base %d, %d statements from %d on", v.base, v.count, v.first) end
INFO[254] = function(v)
    local shows = v["introduction.flags.certificate"] == 1
    if v.sender == 65535 or v.asked > (shows and 5 or 8) or v.proofs > (shows and 0 or 6) then error(CUT, 0) end
    local certificate = shows and " shows its certificate" or ""
    return string.format("%s, asks %d nodes, %d proofs", certificate, v.asked, v.proofs)
end

-- Reads a message; returns what stands in the packet list.
local function read_message(r, number)
    local v = read_layout(r, LAYOUTS[number])
    local info = v.sender and tostring(v.sender) or ""
    if v.target then info = string.format("%s -> %s", info, TARGETS[v.target] or tostring(v.target)) end
    if INFO[number] then return info .. INFO[number](v, r) end
    return info .. ids(v.rows or {})
end

function rass.dissector(tvb, pinfo, root)
    local tree = root:add(rass, tvb())
    if tvb:len() == 0 then
        tree:add_proto_expert_info(malformed)
        return 0
    end
    local head = tvb(0, 1)
    local version, number = head:bitfield(0, 4), head:bitfield(4, 4)
    tree:add(f.version, head)
    tree:add(f.type, head)
    local ahead = 1
    if version == VERSION and number == MORE then
        if tvb:len() == 1 then
            tree:add_proto_expert_info(malformed)
            return 1
        end
        number, ahead = tvb(1, 1):uint(), 2
        tree:add(f.more, tvb(1, 1))
    end
    if version ~= VERSION or not LAYOUTS[number] then
        tree:add_proto_expert_info(foreign)
        tree:append_text(string.format(", version %d, type %d", version, number))
        pinfo.cols.info:append(string.format("[version %d, type %d] ", version, number))
        return tvb:len()
    end
    local reader = setmetatable({ tvb = tvb, at = ahead, tree = tree }, Reader)
    local whole, result = pcall(read_message, reader, number)
    if not whole then
        if result ~= CUT then error(result, 0) end -- our own bug: Wireshark shows it
        tree:add_proto_expert_info(malformed)
        result = "malformed"
    end
    tree:append_text(", " .. TYPES[number] .. " " .. result)
    pinfo.cols.info:append(string.format("[%s] %s  ", TYPES[number], result))
    return tvb:len()
end

-- MAVLink 2 -----------------------------------------------------------------------------------------------------------

-- Length of the MAVLink 2 frame at `at`, or nil if there is none or it does not fit.
local function frame_length(tvb, at)
    local left = tvb:len() - at
    if left < 12 or tvb(at, 1):uint() ~= 0xfd then return nil end
    local flags = tvb(at + 2, 1):uint()
    if flags > 1 then return nil end
    local length = 12 + tvb(at + 1, 1):uint() + flags * SIGNATURE_SIZE
    return length <= left and length or nil
end

local function tunnel(tvb, at, size, pinfo, tree, root)
    -- MAVLink 2 trims zeros at the end of the payload; they come back here.
    local bytes = tvb:range(at, size):bytes()
    if size < AHEAD_OF_DATA then bytes:set_size(AHEAD_OF_DATA) end
    for i = size, bytes:len() - 1 do bytes:set_index(i, 0) end
    local number = bytes:get_index(0) + bytes:get_index(1) * 256
    local length = bytes:get_index(4)
    local shown = tvb:range(at, math.min(size, AHEAD_OF_DATA))
    tree:add(g.payload_type, shown, number)
    tree:add(g.target_system, shown, bytes:get_index(2))
    tree:add(g.target_component, shown, bytes:get_index(3))
    tree:add(g.payload_length, shown, length)
    if number ~= frame.prefs.payload_type or length > 128 then return end
    local inner
    if size >= AHEAD_OF_DATA + length then
        inner = tvb:range(at + AHEAD_OF_DATA, length):tvb()
    else
        local held = math.max(size - AHEAD_OF_DATA, 0)
        bytes:set_size(AHEAD_OF_DATA + length)
        for i = AHEAD_OF_DATA + held, AHEAD_OF_DATA + length - 1 do bytes:set_index(i, 0) end
        inner = length > 0 and bytes:subset(AHEAD_OF_DATA, length):tvb("TUNNEL payload, its zeros restored")
    end
    if not inner or length == 0 then return end
    pinfo.cols.protocol = "RASS"
    rass.dissector(inner, pinfo, root)
end

local function one_frame(tvb, at, length, pinfo, root)
    local size, signed = tvb(at + 1, 1):uint(), tvb(at + 2, 1):uint() == 1
    local message_id = tvb(at + 7, 3):le_uint()
    local tree = root:add(frame, tvb(at, length))
    tree:append_text(message_id == TUNNEL_ID and ", TUNNEL" or ", message " .. message_id)
    tree:add(g.length, tvb(at + 1, 1))
    tree:add(g.incompatible, tvb(at + 2, 1))
    tree:add(g.signed, tvb(at + 2, 1), signed)
    tree:add(g.mav_sequence, tvb(at + 4, 1))
    tree:add(g.system, tvb(at + 5, 1))
    tree:add(g.component, tvb(at + 6, 1))
    tree:add_le(g.message_id, tvb(at + 7, 3))
    local check = tvb(at + 10 + size, 2)
    tree:add_le(g.checksum, check)
    local good = true
    if message_id == TUNNEL_ID then
        good = checksum(tvb, at + 1, at + 9 + size, TUNNEL_EXTRA) == check:le_uint()
        tree:add(g.good, check, good)
        if not good then tree:add_proto_expert_info(bad_checksum) end
    end
    if signed then
        tree:add(g.link_id, tvb(at + 12 + size, 1))
        tree:add_le(g.ticks, tvb(at + 13 + size, 6))
        tree:add(g.signature, tvb(at + 19 + size, 6))
    end
    if message_id == TUNNEL_ID and good then
        tunnel(tvb, at + 10, size, pinfo, tree, root)
    end
end

function frame.dissector(tvb, pinfo, root)
    local at = 0
    local length = frame_length(tvb, at)
    if not length then return 0 end
    pinfo.cols.protocol = "MAVLink"
    pinfo.cols.info = ""
    while length do
        one_frame(tvb, at, length, pinfo, root)
        at = at + length
        length = frame_length(tvb, at)
    end
    return at
end

-- Registration --------------------------------------------------------------------------------------------------------

-- On any port: a datagram that is one TUNNEL frame with our payload_type and a good checksum. Other MAVLink is left to
-- other dissectors.
local function ours(tvb, pinfo, root)
    local length = frame_length(tvb, 0)
    if not length or tvb(7, 3):le_uint() ~= TUNNEL_ID then return false end
    local size = tvb(1, 1):uint()
    if size < AHEAD_OF_DATA or tvb(10, 2):le_uint() ~= frame.prefs.payload_type then return false end
    if checksum(tvb, 1, 9 + size, TUNNEL_EXTRA) ~= tvb(10 + size, 2):le_uint() then return false end
    frame.dissector(tvb, pinfo, root)
    return true
end
frame:register_heuristic("udp", ours)

local udp_ports = DissectorTable.get("udp.port")
local registered = frame.prefs.port
udp_ports:add(registered, frame)
function frame.prefs_changed()
    if registered ~= frame.prefs.port then
        udp_ports:remove(registered, frame)
        registered = frame.prefs.port
        udp_ports:add(registered, frame)
    end
end

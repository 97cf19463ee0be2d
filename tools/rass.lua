-- Wireshark dissector for rass_mav: MAVLink 2 frames in UDP, TUNNEL (message 385) in them, and in it every field of our
-- own payloads (docs/protocol.md). How to use it: tools/README.md.
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

local TYPES = { "Beacon", "Data", "Offer", "Accept", "Chunk", "Sack", "Committed", "Receipt", "Deletion report", "Put",
    "Query", "Passed on", "Copy statuses", "Sequence mark", "more", "Summary", [248] = "Key summary", [249] = "Key update", [251] = "Ask",
    [252] = "Anchor", [253] = "Statement signature", [254] = "Introduction" }
local BLOCKS = { [1] = "answers", [2] = "a distant replica", [3] = "motion", [4] = "proof of the route",
    [5] = "tags of the answers", [6] = "key of the beacon" }
local VERSION = 3
local KINDS = {}
for kind, name in pairs({ [0] = "bytes", [1] = "measurement", [2] = "file", [3] = "status" }) do
    KINDS[kind], KINDS[kind + 64] = name, name .. " with terms"
    KINDS[kind + 128], KINDS[kind + 192] = "sealed " .. name, "sealed " .. name .. " with terms"
end
local REASONS = { [1] = "corrupted", [2] = "expired", [3] = "overflow", [4] = "died", [5] = "vanished",
    [6] = "numbers unknown from here on", [7] = "store damaged" }
local STATUSES = { [0] = "again", [1] = "none", [2] = "taken", [3] = "still", [4] = "wanted", [5] = "here", [6] = "enclosed" }
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
field("sender", ProtoField.uint16, "rass.sender", "Sender")
field("target", ProtoField.uint16, "rass.target", "Target", base.DEC, TARGETS)
field("life", ProtoField.uint32, "rass.life", "Life", base.HEX)
field("epoch", ProtoField.uint32, "rass.epoch", "Epoch", base.HEX)
field("beacon", ProtoField.uint16, "rass.beacon", "Beacon number")
field("flags", ProtoField.uint8, "rass.flags", "Flags", base.HEX)
field("flag_base", ProtoField.bool, "rass.flags.base", "Sender is a base", 8, nil, 1)
field("flag_wanted", ProtoField.bool, "rass.flags.wanted", "Wants a newer announcement", 8, nil, 2)
field("base", ProtoField.uint16, "rass.base", "Base")
field("base_life", ProtoField.uint32, "rass.base_life", "Base life", base.HEX)
field("route_number", ProtoField.uint16, "rass.route_number", "Announcement number")
field("hops", ProtoField.uint8, "rass.hops", "Hops to the base (255: no route)")
field("wanted_base", ProtoField.uint16, "rass.wanted_base", "Wanted base")
field("wanted_number", ProtoField.uint16, "rass.wanted_number", "Wanted announcement")
field("risk", ProtoField.uint16, "rass.risk", "Risk (65535 is 1)")
field("free", ProtoField.uint16, "rass.free", "Free items (65535: no bound)")
field("policy", ProtoField.uint16, "rass.policy", "Policy tag", base.HEX)
field("potential", ProtoField.uint32, "rass.potential", "Potential (16777216 is fitness 1)")
field("statements_hash", ProtoField.uint32, "rass.statements_hash", "Hash of the statements", base.HEX)
field("beacon_crc", ProtoField.uint32, "rass.beacon_crc", "CRC of the beacon", base.HEX)
field("turn", ProtoField.uint16, "rass.turn", "Turn, tenths of a second (0: a step)")
field("moves", ProtoField.uint64, "rass.moves", "Motion", base.HEX)
field("proof", ProtoField.bytes, "rass.proof", "Element of the hash chain")
field("count", ProtoField.uint8, "rass.count", "Entries")
field("data_count", ProtoField.uint8, "rass.count", "Hand-overs", base.DEC, nil, 0x7f)
field("replica", ProtoField.bool, "rass.replica", "Replicas", 8, nil, 0x80)
field("near", ProtoField.uint16, "rass.near", "Distant replicas: away from")
field("custodian", ProtoField.uint16, "rass.custodian", "Distant replicas: custodian")
field("further", ProtoField.uint8, "rass.further", "Distant replicas: so many more")
field("number", ProtoField.uint32, "rass.number", "Hand-over number", base.HEX)
field("origin", ProtoField.uint16, "rass.origin", "Datum: origin")
field("sequence", ProtoField.uint32, "rass.sequence", "Datum: sequence")
field("age", ProtoField.uint32, "rass.age", "Age, ms", base.DEC, nil, 0x7fffffff)
field("at_least", ProtoField.bool, "rass.at_least", "At least so old", 32, nil, 0x80000000)
field("datum_hops", ProtoField.uint8, "rass.datum_hops", "Hand-overs so far")
field("kind", ProtoField.uint8, "rass.kind", "Kind", base.DEC, KINDS)
field("crc", ProtoField.uint32, "rass.crc", "CRC", base.HEX)
field("size", ProtoField.uint32, "rass.size", "Size, bytes")
field("small_size", ProtoField.uint8, "rass.size", "Size, bytes")
field("payload", ProtoField.bytes, "rass.payload", "Payload of the datum")
field("priority", ProtoField.uint8, "rass.priority", "Priority")
field("lifetime", ProtoField.uint24, "rass.lifetime", "Lifetime, s; 0: none")
field("chunk_size", ProtoField.uint8, "rass.chunk_size", "Chunk size, bytes")
field("handle", ProtoField.uint16, "rass.handle", "Handle", base.HEX)
field("next_index", ProtoField.uint16, "rass.next_index", "First missing chunk")
field("position", ProtoField.uint16, "rass.position", "Chunk", base.DEC, nil, 0x7fff)
field("poll", ProtoField.bool, "rass.poll", "Wants a sack", 16, nil, 0x8000)
field("data", ProtoField.bytes, "rass.data", "Data of the chunk")
field("question", ProtoField.uint16, "rass.question", "Answers the question")
field("bitmap_size", ProtoField.uint8, "rass.bitmap_size", "Bytes of bitmap")
field("bitmap", ProtoField.bytes, "rass.bitmap", "Bitmap")
field("committed", ProtoField.uint8, "rass.committed", "Committed pairs")
field("block", ProtoField.uint8, "rass.block", "Kind of block", base.DEC, BLOCKS)
field("block_size", ProtoField.uint8, "rass.block_size", "Bytes in the block")
field("block_content", ProtoField.bytes, "rass.block_content", "Content of the block")
field("refused", ProtoField.uint8, "rass.refused", "Refused numbers")
field("refused_number", ProtoField.uint32, "rass.refused_number", "Refused hand-over", base.HEX)
field("serial", ProtoField.uint32, "rass.serial", "Serial of the statement")
field("first", ProtoField.uint32, "rass.first", "First sequence")
field("run", ProtoField.uint32, "rass.run", "Sequences that follow each other")
field("entry_size", ProtoField.uint8, "rass.entry_size", "Bytes of bitmap", base.DEC, nil, 0x7f)
field("lost", ProtoField.bool, "rass.lost", "Told lost", 8, nil, 0x80)
field("entry_bitmap", ProtoField.bytes, "rass.entry_bitmap", "Bitmap: first + run + i too")
field("assigned", ProtoField.uint32, "rass.assigned", "Sequences below this one have been assigned")
field("bits", ProtoField.uint8, "rass.bits", "Matches one in 2 ^ this of the data that have not arrived")
field("mark_bytes", ProtoField.uint8, "rass.mark_bytes", "Bytes of packed marks")
field("mark", ProtoField.uint32, "rass.mark", "Mark")
field("status", ProtoField.uint8, "rass.status", "Copy status", base.DEC, STATUSES)
field("reason", ProtoField.uint8, "rass.reason", "Reason", base.DEC, REASONS)
field("report_count", ProtoField.uint8, "rass.count", "Losses", base.DEC, nil, 0x7f)
field("report_proof", ProtoField.bytes, "rass.report_proof", "Who has created it, and the tag for the ground")
field("lamport", ProtoField.uint16, "rass.lamport", "Lamport timestamp")
field("writer", ProtoField.uint16, "rass.writer", "Writer")
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
field("tag", ProtoField.bytes, "rass.tag", "Tag: who says it, not checked")
field("place", ProtoField.uint64, "rass.place", "Place among the statements of the sender", base.HEX)
field("nonce", ProtoField.uint64, "rass.nonce", "Nonce", base.HEX)
field("asked", ProtoField.uint8, "rass.asked", "Asked")
field("i_flags", ProtoField.uint8, "rass.introduction.flags", "Flags", base.HEX)
field("i_certificate", ProtoField.bool, "rass.introduction.flags.certificate", "A certificate follows", 8, nil, 1)
field("i_wanted", ProtoField.bool, "rass.introduction.flags.wanted", "Who is asked should send theirs", 8, nil, 2)
field("beacon_index", ProtoField.uint32, "rass.introduction.beacon", "Index of the sender's last beacon")
field("beacon_key", ProtoField.bytes, "rass.key", "Key of the beacon")
field("next_end", ProtoField.bytes, "rass.introduction.next_end", "End of the next chain of keys")
field("proofs", ProtoField.uint8, "rass.proofs", "Proofs")
field("node_id", ProtoField.uint16, "rass.node_id", "Node id")
field("node_serial", ProtoField.uint32, "rass.node_serial", "Serial of the node (0: a base)")
field("public_key", ProtoField.bytes, "rass.public_key", "Public key")
field("signature", ProtoField.bytes, "rass.signature", "Signature by the ground, not checked")
field("first_serial", ProtoField.uint32, "rass.first_serial", "Serial of the first statement")
field("salt", ProtoField.uint32, "rass.salt", "Salt", base.HEX)
field("hash", ProtoField.bytes, "rass.hash", "Hash of a statement")
field("chain", ProtoField.uint32, "rass.chain", "Serial of the chain")
field("first_number", ProtoField.uint16, "rass.first_number", "First announcement number of the chain")
field("anchor", ProtoField.bytes, "rass.anchor", "Anchor")
field("bases", ProtoField.uint8, "rass.bases", "Bases whose anchors are lacking")
field("statements", ProtoField.uint8, "rass.statements", "Statements whose signatures are lacking")
field("update_flags", ProtoField.uint8, "rass.update.flags", "Flags", base.DEC, UPDATES)
field("link_key", ProtoField.uint32, "rass.link_key", "Number of the link key")
field("sealed_key", ProtoField.bytes, "rass.sealed_key", "Sealed key")
field("updates_hash", ProtoField.uint32, "rass.updates_hash", "Hash of the key updates (0: none)", base.HEX)
field("first_node", ProtoField.uint16, "rass.first_node", "First")
field("last_node", ProtoField.uint16, "rass.last_node", "Last (below the first: none is named)")
field("row_serial", ProtoField.uint8, "rass.row.serial", "Low 7 bits of the serial", base.DEC, nil, 0xfe)
field("row_revoked", ProtoField.bool, "rass.row.revoked", "Revoked", 8, nil, 1)
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

local function title_of_id(r)
    return string.format("%d-%08x-%d", r.tvb(r.at, 2):le_uint(), r.tvb(r.at + 2, 4):le_uint(),
        r.tvb(r.at + 6, 4):le_uint())
end

local function datum_id(r)
    if r.at + 10 > r.tvb:len() then error(CUT, 0) end
    local title = title_of_id(r)
    r:number("origin", 2)
    r:number("epoch", 4)
    r:number("sequence", 4)
    return title
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

local function age(r)
    local range = r:need(4)
    r.tree:add_le(f.age, range)
    r.tree:add_le(f.at_least, range)
end

-- What Data and Put have in common: id, age, hops, kind, CRC, size, payload.
local function whole_datum(r)
    local title = datum_id(r)
    age(r)
    r:number("datum_hops", 1)
    local kind = r:number("kind", 1)
    r:number("crc", 4)
    local size = r:number("small_size", 1)
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
    return title
end

local function times(r, count, title, read)
    for i = 1, count do
        r:branch(string.format("%s %d", title, i), read)
    end
end

local READ = {}

-- An answer to hand-overs, but for its sender; returns how many pairs and numbers it has.
local function answer(r)
    local committed = r:number("committed", 1)
    local refused = r:number("refused", 1)
    times(r, committed, "Committed", function()
        r:number("number", 4)
        r:number("crc", 4)
    end)
    for _ = 1, refused do r:number("refused_number", 4) end
    return committed, refused
end

-- What a block holds, by its kind; `last`: where it ends. Smaller ones than `SMALLEST` are of no use.
local BLOCK = {}
local SMALLEST = { [2] = 5, [3] = 8, [4] = 8, [6] = 8 }

BLOCK[1] = function(r, last)
    while r.at < last do
        r:branch("Answer", function()
            r:number("target", 2)
            answer(r)
        end)
    end
    if r.at > last then error(CUT, 0) end
end

BLOCK[2] = function(r)
    r:number("near", 2)
    r:number("custodian", 2)
    r:number("further", 1)
end

BLOCK[3] = function(r) r:wide("moves", 8) end

BLOCK[4] = function(r) r:bytes("proof", 8) end

BLOCK[5] = function(r, last)
    while r.at + TAG_SIZE <= last do r:bytes("tag", TAG_SIZE) end
end

BLOCK[6] = function(r) r:bytes("beacon_key", 8) end

-- What follows the fields of a beacon and the hand-overs of data, up to the end.
local function blocks(r)
    while r:left() > 0 do
        r:branch("Block", function()
            local kind = r:number("block", 1)
            local size = r:number("block_size", 1)
            local last = r.at + size
            if last > r.tvb:len() then error(CUT, 0) end
            if BLOCK[kind] and size >= (SMALLEST[kind] or 0) then BLOCK[kind](r, last) end
            if r.at < last then r:bytes("block_content", last - r.at) end
        end)
    end
end

-- The tag behind an answer or a statement about a copy, if there is one.
local function tag(r)
    if r:left() > 0 then r:bytes("tag", math.min(r:left(), TAG_SIZE)) end
end

-- The place of such a statement, and its tags: to everybody, each has the node id of the receiver before it.
local function place_and_tags(r, target)
    if r:left() < 4 then return end
    r:wide("place", 4)
    if target ~= 65535 then return tag(r) end
    while r:left() >= 2 + TAG_SIZE do
        r:branch("Receiver", function()
            r:number("node_id", 2)
            r:bytes("tag", TAG_SIZE)
        end)
    end
end

READ[1] = function(r)
    local sender = r:number("sender", 2)
    if sender == 65535 then error(CUT, 0) end
    r:number("life", 4)
    r:number("beacon", 2)
    local flags = r:need(1)
    local branch = r.tree:add(f.flags, flags)
    branch:add(f.flag_base, flags)
    branch:add(f.flag_wanted, flags)
    local to = r:number("base", 2)
    r:number("base_life", 4)
    r:number("route_number", 2)
    local hops = r:number("hops", 1)
    r:number("wanted_base", 2)
    r:number("wanted_number", 2)
    local risk = r:number("risk", 2)
    r:number("free", 2)
    r:number("policy", 2)
    r:number("potential", 4)
    r:number("statements_hash", 4)
    local crc = r:number("beacon_crc", 4)
    r:number("turn", 2)
    if crc ~= crc_32_around(r.tvb, 37, 4) then error(CUT, 0) end
    blocks(r)
    local way = hops == 255 and "no route" or string.format("%d hops to %d", hops, to)
    return string.format("%d: %s, risk %.3f", sender, way, risk / 65535)
end

-- Sender and target; returns the beginning of the line in the packet list, and the target.
local function to_one(r)
    local sender = r:number("sender", 2)
    local target = r:number("target", 2)
    return string.format("%d -> %s", sender, TARGETS[target] or tostring(target)), target
end

READ[2] = function(r)
    local info = to_one(r)
    local count = r:need(1)
    r.tree:add(f.data_count, count)
    r.tree:add(f.replica, count)
    if count:uint() >= 128 then info = info .. ", replicas" end
    times(r, count:uint() % 128, "Hand-over", function()
        r:number("number", 4)
        info = info .. " " .. whole_datum(r)
    end)
    blocks(r)
    return info
end

READ[3] = function(r)
    local info = to_one(r)
    r:number("number", 4)
    info = info .. " " .. datum_id(r)
    age(r)
    r:number("datum_hops", 1)
    r:number("kind", 1)
    r:number("crc", 4)
    local size = r:number("size", 4)
    local chunk = r:number("chunk_size", 1)
    if size == 0 or chunk == 0 or chunk > 123 then error(CUT, 0) end
    return string.format("%s, %d bytes", info, size)
end

local function bitmap(r, most)
    local size = r:number("bitmap_size", 1)
    if size > most then error(CUT, 0) end
    r:bytes("bitmap", size)
end

READ[4] = function(r)
    local info = to_one(r)
    r:number("number", 4)
    local handle = r:number("handle", 2)
    local next_index = r:number("next_index", 2)
    if r.at < r.tvb:len() then bitmap(r, 32) end
    return string.format("%s %04x, from chunk %d on", info, handle, next_index)
end

READ[5] = function(r)
    local handle = r:number("handle", 2)
    local index = r:need(2)
    r.tree:add_le(f.position, index)
    r.tree:add_le(f.poll, index)
    local size = r.tvb:len() - r.at
    r:bytes("data", size)
    if size == 0 then return string.format("%04x, question %d", handle, index:le_uint() % 32768) end
    return string.format("%04x, chunk %d, %d bytes", handle, index:le_uint() % 32768, size)
end

READ[6] = function(r)
    local info = to_one(r)
    local handle = r:number("handle", 2)
    local next_index = r:number("next_index", 2)
    bitmap(r, 32)
    if r.at < r.tvb:len() then
        r:number("question", 2)
        local count = r:number("count", 1)
        if count > 3 then error(CUT, 0) end
        for _ = 1, count do
            r:number("handle", 2)
            r:number("next_index", 2)
            bitmap(r, 16)
        end
    end
    return string.format("%s %04x, all below chunk %d", info, handle, next_index)
end

READ[7] = function(r)
    local info = to_one(r)
    local committed, refused = answer(r)
    tag(r)
    return string.format("%s, %d committed, %d refused", info, committed, refused)
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

READ[8] = function(r)
    local from = r:number("base", 2)
    r:number("base_life", 4)
    r:number("serial", 4)
    r:number("crc", 4)
    local count = r:number("count", 1)
    times(r, count, "Entry", function()
        r:number("origin", 2)
        r:number("epoch", 4)
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
    end)
    return string.format("base %d, %d entries", from, count)
end

READ[9] = function(r)
    local info = to_one(r)
    local count = r:need(1)
    r.tree:add(f.report_count, count)
    local proven = count:uint() >= 128
    times(r, count:uint() % 128, "Lost", function()
        r:number("number", 4)
        info = info .. " " .. datum_id(r)
        r:number("reason", 1)
        r:number("crc", 4)
        if proven then r:bytes("report_proof", 10) end
    end)
    return info
end

READ[10] = function(r)
    local sender = r:number("sender", 2)
    r:number("lamport", 2)
    r:number("writer", 2)
    return string.format("%d: %s", sender, whole_datum(r))
end

READ[11] = function(r)
    local info = to_one(r)
    times(r, r:number("count", 1), "Key", function() info = info .. " " .. datum_id(r) end)
    return info
end

READ[12] = function(r)
    local info, target = to_one(r)
    times(r, r:number("count", 1), "Datum", function() info = info .. " " .. datum_id(r) end)
    place_and_tags(r, target)
    return info
end

READ[13] = function(r)
    local info, target = to_one(r)
    times(r, r:number("count", 1), "Datum", function()
        local id = datum_id(r)
        local status = r:number("status", 1)
        info = string.format("%s %s %s", info, STATUSES[status] or tostring(status), id)
    end)
    place_and_tags(r, target)
    return info
end

READ[14] = function(r)
    local origin = r:number("origin", 2)
    r:number("epoch", 4)
    local assigned = r:number("assigned", 4)
    r:number("crc", 4)
    return string.format("%d has assigned %d", origin, assigned)
end

-- The bits of a range, the low ones of each byte first.
local function bit_reader(range)
    local at = 0
    return function()
        local byte = math.floor(at / 8)
        if byte >= range:len() then error(CUT, 0) end
        local bit = math.floor(range(byte, 1):uint() / 2 ^ (at % 8)) % 2
        at = at + 1
        return bit
    end
end

READ[16] = function(r)
    local from = r:number("base", 2)
    r:number("base_life", 4)
    r:number("serial", 4)
    r:number("crc", 4)
    local count = r:number("count", 1)
    local bits = r:number("bits", 1)
    local size = r:number("mark_bytes", 1)
    if count == 0 or bits < 8 or bits > 16 or size > 89 then error(CUT, 0) end
    local packed = r:need(size)
    local bit, mark = bit_reader(packed), 0
    for _ = 1, count do
        while bit() == 1 do mark = mark + 2 ^ bits end
        for i = 0, bits - 1 do mark = mark + bit() * 2 ^ i end
        r.tree:add(f.mark, packed, mark)
    end
    return string.format("base %d, %d data of late", from, count)
end

-- What nodes with keys say about links and keys, and what the ground has signed. -------------------------------------

local SIGNATURE = 64

READ[254] = function(r)
    local sender = r:number("sender", 2)
    local flags = r:need(1)
    local branch = r.tree:add(f.i_flags, flags)
    branch:add(f.i_certificate, flags)
    branch:add(f.i_wanted, flags)
    local shows = flags:uint() % 2 == 1
    local asked = r:number("asked", 1)
    local proofs = r:number("proofs", 1)
    if sender == 65535 or asked > (shows and 5 or 8) or proofs > (shows and 0 or 6) then error(CUT, 0) end
    if shows then
        r:branch("Certificate", function()
            r:number("node_id", 2)
            r:number("node_serial", 4)
            r:bytes("public_key", 32)
            r:bytes("signature", SIGNATURE)
        end)
    end
    if asked > 0 then
        r:wide("nonce", 8)
        for _ = 1, asked do r:number("node_id", 2) end
    end
    if proofs > 0 then
        r:wide("place", 8)
        r:number("beacon_index", 4)
        r:bytes("beacon_key", 8)
        r:bytes("next_end", 8)
        times(r, proofs, "Proof", function()
            r:number("node_id", 2)
            r:bytes("tag", TAG_SIZE)
        end)
    end
    return string.format("%d%s, asks %d nodes, %d proofs", sender, shows and " shows its certificate" or "", asked, proofs)
end

READ[253] = function(r)
    local from = r:number("base", 2)
    r:number("base_life", 4)
    local first = r:number("first_serial", 4)
    r:number("salt", 4)
    local count = r:number("count", 1)
    if count == 0 or count > 5 then error(CUT, 0) end
    for _ = 1, count do r:bytes("hash", 8) end
    r:bytes("signature", SIGNATURE)
    return string.format("base %d, %d statements from %d on", from, count, first)
end

READ[252] = function(r)
    local from = r:number("base", 2)
    r:number("base_life", 4)
    local chain = r:number("chain", 4)
    local first = r:number("first_number", 2)
    r:bytes("anchor", 8)
    r:bytes("signature", SIGNATURE)
    return string.format("base %d, chain %d from number %d on", from, chain, first)
end

READ[251] = function(r)
    local bases = r:number("bases", 1)
    local statements = r:number("statements", 1)
    if bases > 4 or statements > 9 then error(CUT, 0) end
    times(r, bases, "Base", function()
        r:number("base", 2)
        r:number("base_life", 4)
    end)
    times(r, statements, "Statement", function()
        r:number("base", 2)
        r:number("base_life", 4)
        r:number("serial", 4)
    end)
    return string.format("lacks %d anchors, %d statement signatures", bases, statements)
end

READ[249] = function(r)
    local flags = r:number("update_flags", 1)
    if flags > 1 then error(CUT, 0) end
    local number = r:number("link_key", 4)
    local drone = r:number("node_id", 2)
    r:number("node_serial", 4)
    if flags == 0 then r:bytes("sealed_key", 48) end
    r:bytes("signature", SIGNATURE)
    return string.format("link key %d, drone %d %s", number, drone, UPDATES[flags])
end

READ[248] = function(r)
    local from = r:number("node_id", 2)
    r:number("node_serial", 4)
    local number = r:number("link_key", 4)
    r:number("updates_hash", 4)
    r:number("first_node", 2)
    r:number("last_node", 2)
    local count = r:number("count", 1)
    if count > 35 then error(CUT, 0) end
    times(r, count, "Key update", function()
        r:number("node_id", 2)
        local mark = r:need(1)
        r.tree:add(f.row_serial, mark)
        r.tree:add(f.row_revoked, mark)
    end)
    return string.format("%d has link key %d, names %d key updates", from, number, count)
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
    if version == VERSION and number == 15 then
        if tvb:len() == 1 then
            tree:add_proto_expert_info(malformed)
            return 1
        end
        number, ahead = tvb(1, 1):uint(), 2
        tree:add(f.more, tvb(1, 1))
    end
    local read = READ[number]
    if version ~= VERSION or not read then
        tree:add_proto_expert_info(foreign)
        tree:append_text(string.format(", version %d, type %d", version, number))
        pinfo.cols.info:append(string.format("[version %d, type %d] ", version, number))
        return tvb:len()
    end
    local reader = setmetatable({ tvb = tvb, at = ahead, tree = tree }, Reader)
    local whole, result = pcall(read, reader)
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

-- ArduPilot Lua script: sends the radiation reading, in counts per second, as NAMED_VALUE_FLOAT "RAD" once a second.
--
-- Copy it to APM/scripts on the autopilot's card, set SCR_ENABLE 1 and reboot. Its parameters then appear. After a
-- change of RADS_SOURCE, RADS_PORT, RADS_BAUD or RADS_PIN, reboot again. See README.md in this folder.
--
--   RADS_SOURCE   0 nothing, 1 a Geiger counter on a serial port, 2 pulses on a pin, 3 simulated (for SITL)
--   RADS_PORT     serial: which of the ports with SERIALn_PROTOCOL 28, counted from 0
--   RADS_BAUD     serial: baud rate
--   RADS_PIN      pin: its GPIO number, for example 54; its SERVOn_FUNCTION must be -1
--   RADS_EDGES    pin: 1: a count at each rise; 2: at each change of level (with a flip-flop after the counter)
--   RADS_DEAD_US  serial and pin: dead time of the tube in microseconds; 0: no correction
--   RADS_NORTH, RADS_EAST   simulated: position of the source, metres from home
--   RADS_CPS      simulated: counts per second at the source itself
--   RADS_DECAY    simulated: how fast the level falls, 1/m^2: RADS_CPS / (1 + RADS_DECAY * distance^2)
--   RADS_BACK     simulated: background, counts per second
--
-- When the counter is silent, nothing is sent. The node then treats the risk as unknown, which counts as the worst.

local NAME = "RAD"
local PERIOD_MS = 1000
local SERIAL_MS = 200 -- how often the serial port is read
local POLL_MS = 2 -- how often the pin is read: a level must last longer than this to be seen
local SILENT_MS = 5000 -- after this long without a line the counter counts as silent
local MAX_BYTES = 512 -- read from the port at once
local MAX_LINE = 120
local WARNING, INFO = 4, 6 -- severities of STATUSTEXT

local TABLE_KEY = 121 -- key of the script's parameters; no other script on the vehicle may use it
local PREFIX = "RADS_"
local PARAMETERS = {
    { "SOURCE", 1 }, { "PORT", 0 }, { "BAUD", 9600 }, { "PIN", -1 }, { "EDGES", 1 }, { "DEAD_US", 0 },
    { "NORTH", 0 }, { "EAST", 0 }, { "CPS", 100 }, { "DECAY", 0.01 }, { "BACK", 0.5 },
}

assert(param:add_table(TABLE_KEY, PREFIX, #PARAMETERS), "rass_rad: could not add its parameters")
local setting = {}
for number, about in ipairs(PARAMETERS) do
    assert(param:add_param(TABLE_KEY, number, about[1], about[2]), "rass_rad: could not add " .. about[1])
    setting[about[1]] = Parameter()
    assert(setting[about[1]]:init(PREFIX .. about[1]), "rass_rad: could not find " .. about[1])
end

local function value(name)
    return setting[name]:get() or 0
end

local function now_ms()
    return millis():tofloat()
end

-- Sends a text when it changes, not every time.
local told = ""
local function tell(severity, text)
    if text ~= told then
        told = text
        gcs:send_text(severity, "rass_rad: " .. text)
    end
end

local function send(cps)
    gcs:send_named_float(NAME, cps)
end

-- True count rate of a tube that is blind during the dead time after each count (non-paralysable): m / (1 - m * dead time).
local function corrected(cps)
    local blind = cps * value("DEAD_US") * 1e-6
    if blind >= 0.95 then blind = 0.95 end -- above this the tube is saturated, and the formula means nothing
    return cps / (1 - blind)
end

-- A serial counter ----------------------------------------------------------------------------------------------------

-- Counts per second in a line such as "CPS, 0, CPM, 13, uSv/hr, 0.07, SLOW"; nil if it has none.
local function cps_in(line)
    local cps = line:match("CPS%s*[,:=]%s*(%d+%.?%d*)")
    if cps then return tonumber(cps) end
    local cpm = line:match("CPM%s*[,:=]%s*(%d+%.?%d*)")
    return cpm and tonumber(cpm) / 60
end

local port
local line = ""
local heard_ms

local function serial_counter()
    if not port then
        port = serial:find_serial(math.floor(value("PORT")))
        if not port then
            tell(WARNING, "no serial port with protocol 28")
            return serial_counter, SILENT_MS
        end
        port:begin(math.floor(value("BAUD")))
        port:set_flow_control(0)
        heard_ms = now_ms()
    end
    local newest
    for _ = 1, MAX_BYTES do
        local byte = port:read()
        if not byte or byte < 0 then break end
        if byte == 10 or byte == 13 then
            newest = cps_in(line) or newest
            line = ""
        elseif #line < MAX_LINE then
            line = line .. string.char(byte)
        end
    end
    if newest then
        heard_ms = now_ms()
        tell(INFO, "the counter is heard")
        send(corrected(newest))
    elseif now_ms() - heard_ms > SILENT_MS then
        tell(WARNING, "the counter is silent")
    end
    return serial_counter, SERIAL_MS
end

-- Pulses on a pin -----------------------------------------------------------------------------------------------------

local level
local counts, since_ms = 0, 0

local function pulse_counter()
    local pin = math.floor(value("PIN"))
    if pin < 0 then
        tell(WARNING, "set RADS_PIN to the pin of the counter")
        return pulse_counter, SILENT_MS
    end
    if level == nil then
        gpio:pinMode(pin, 0)
        level = gpio:read(pin)
        since_ms = now_ms()
        tell(INFO, "counting pulses")
        return pulse_counter, POLL_MS
    end
    local is = gpio:read(pin)
    if is ~= level then
        level = is
        if is or value("EDGES") >= 2 then counts = counts + 1 end
    end
    local elapsed = now_ms() - since_ms
    if elapsed >= PERIOD_MS then
        send(corrected(counts * 1000 / elapsed))
        counts, since_ms = 0, since_ms + elapsed
    end
    return pulse_counter, POLL_MS
end

-- A simulated source --------------------------------------------------------------------------------------------------

-- A random number of counts with this mean. Knuth's method; for large means a normal distribution is close enough.
local function poisson(mean)
    if mean > 50 then
        local normal = math.sqrt(-2 * math.log(1 - math.random())) * math.cos(2 * math.pi * math.random())
        return math.max(0, math.floor(mean + math.sqrt(mean) * normal + 0.5))
    end
    local limit, product, count = math.exp(-mean), math.random(), 0
    while product > limit do
        product = product * math.random()
        count = count + 1
    end
    return count
end

local function made_up()
    local place = ahrs:get_relative_position_NED_home()
    if not place then
        tell(INFO, "waiting for a position")
        return made_up, PERIOD_MS
    end
    tell(INFO, "the readings are simulated")
    local north, east = place:x() - value("NORTH"), place:y() - value("EAST")
    local square = north * north + east * east + place:z() * place:z()
    send(poisson(math.max(0, value("BACK") + value("CPS") / (1 + value("DECAY") * square))))
    return made_up, PERIOD_MS
end

local START = { [1] = serial_counter, [2] = pulse_counter, [3] = made_up }
local start = START[math.floor(value("SOURCE"))]
if not start then
    tell(INFO, "off (RADS_SOURCE)")
    return
end
return start, PERIOD_MS

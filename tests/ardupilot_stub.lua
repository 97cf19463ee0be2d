-- Enough of ArduPilot's scripting API to run firmware_params/rass_rad.lua on a desk, in virtual time.
--
--     lua5.3 ardupilot_stub.lua SCRIPT SECONDS [NAME=VALUE ...] [serial=FILE] [pulses=HZ] [place=N,E,D]
--
-- Prints "RAD SECONDS VALUE" for each value sent and "TEXT SECONDS SEVERITY WORDS" for each message. What it does not
-- simulate: time that the script itself takes, its share of memory, and other scripts.
--
-- serial=FILE: each line of the file arrives a second after the one before it; a blank line is a second of silence.
-- pulses=HZ: the level of the pin changes so many times a second, evenly.

local script, seconds = arg[1], tonumber(arg[2])
local given, options = {}, {}
for i = 3, #arg do
    local name, text = arg[i]:match("^(%w[%w_]*)=(.*)$")
    if name:match("^%u") then given[name] = tonumber(text) else options[name] = text end
end

local now = 0 -- milliseconds

-- The autopilot's 32 bit numbers are objects; a script must ask them for a plain number.
local Unsigned = {}
Unsigned.__index = Unsigned
function Unsigned:tofloat() return self.number + 0.0 end
function Unsigned:toint() return math.tointeger(self.number) end
function millis() return setmetatable({ number = now }, Unsigned) end

local values = {}
param = {}
local prefix
function param:add_table(key, name, count)
    assert(math.type(key) == "integer" and key <= 200 and count <= 63)
    prefix = name
    return true
end
function param:add_param(key, number, name, default)
    assert(math.type(number) == "integer" and #(prefix .. name) <= 16)
    local full = prefix .. name
    values[full] = given[full] or default
    return true
end
function Parameter()
    return {
        init = function(self, name) self.name = name return values[name] ~= nil end,
        get = function(self) return values[self.name] + 0.0 end,
    }
end

gcs = {}
function gcs:send_named_float(name, value)
    assert(#name <= 10 and type(value) == "number")
    print(string.format("%s %.3f %.6f", name, now / 1000, value))
end
function gcs:send_text(severity, text)
    assert(math.type(severity) == "integer" and #text <= 50)
    print(string.format("TEXT %.3f %d %s", now / 1000, severity, text))
end

local lines = {}
if options.serial then
    for line in io.lines(options.serial) do lines[#lines + 1] = line end
end
local fed, buffer = 0, ""
local port = {}
function port:begin(baud) assert(math.type(baud) == "integer") self.open = true end
function port:set_flow_control(mode) assert(mode == 0) end
function port:read()
    assert(self.open)
    while fed < #lines and now >= (fed + 1) * 1000 do
        fed = fed + 1
        if lines[fed] ~= "" then buffer = buffer .. lines[fed] .. "\r\n" end
    end
    if buffer == "" then return -1 end
    local byte = buffer:byte()
    buffer = buffer:sub(2)
    return byte
end
serial = {}
function serial:find_serial(instance)
    assert(math.type(instance) == "integer")
    return options.serial and instance == 0 and port or nil
end

gpio = {}
function gpio:pinMode(pin, mode) assert(math.type(pin) == "integer" and mode == 0) end
function gpio:read(pin)
    assert(math.type(pin) == "integer")
    return math.floor(now / 1000 * tonumber(options.pulses)) % 2 == 1
end

ahrs = {}
function ahrs:get_relative_position_NED_home()
    if not options.place then return nil end
    local n, e, d = options.place:match("^(.-),(.-),(.-)$")
    return {
        x = function() return tonumber(n) end,
        y = function() return tonumber(e) end,
        z = function() return tonumber(d) end,
    }
end

math.randomseed(1)
local run, delay = dofile(script)
while run do
    assert(math.type(delay) == "integer")
    now = now + delay
    if now > seconds * 1000 then break end
    run, delay = run()
end

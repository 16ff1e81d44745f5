-- Dissects what fipa processes send: frames over TCP, TLS, QUIC and Unix domain sockets, datagrams over UDP,
-- and the letters in them (FIPA00069, FIPA00070, FIPA00071, FIPA00088). Letters without frames, as legacy peers
-- send them, are dissected too.
--
-- For Wireshark 4.0 and later. README.md in this directory describes the installation, the filters and the limits.
--
-- Rules of this file: bytes of a capture are untrusted. A parser calls `malformed` when bytes contradict the
-- format; `guarded` turns this into an expert item. Lengths are compared with the available bytes before bytes are
-- read, nesting and the number of items are bounded, and texts are escaped before they are shown.

local fipa = Proto("fipa", "FIPA letters")
local streams_of_quic = Proto("fipa_quic", "FIPA letters, streams of QUIC")
local message_only = Proto("fipa_acl", "FIPA ACL message")

-- Layout of transport-net/src/stream/frame, transport-net/src/udp/packet.rs and transport/src/wire.
local MAGIC = "fipa"
local VERSION = 3
local FRAME_HEADER = 24
local PARCEL_HEADER = 80
local DATAGRAM_HEADER = 16
local COMMON = 8

-- Bounds of this dissector.
local MAX_ITEMS = 20000
local MAX_TEXT = 1024 * 1024
local MAX_DEPTH = 32
local MAX_SHOWN = 65536
local MAX_INFO = 12

local ONE_MORE_SEGMENT = DESEGMENT_ONE_MORE_SEGMENT or 0x0fffffff

local FRAME_KINDS = { "hello", "parcel", "answer", "ping", "pong", "goodbye" }
local DATAGRAM_KINDS = { "hello", "cookie", "welcome", "refused", "unknown", "data" }
local PACKET_FRAMES =
    { [0] = "padding", "acknowledgment", "parcel", "answer", "ping", "skipped", "goodbye" }
local PARCEL_KINDS = { "letter", "report", "credit", "predecessor" }
local ANSWERS = {
    [0] = "accepted", "in custody", "busy", "out of order", "failed", "returned", "moved", "delivered",
}
local REASONS = {
    [0] = "no such agent", "queue full", "unreachable", "refused", "too large", "timed out", "unconfirmed", "loop",
    "closed", "inexpressible", "unsupported", "no room",
}
local FAULTS = {
    [0] = "unreachable", "wrong incarnation", "too large", "congested", "broken", "timed out", "incompatible",
    "refused", "closed", "exhausted", "inexpressible", "unsupported", "no room",
}
local TRANSPORTS = { [0] = "shm", "tcp", "udp", "quic", "unix", "udt", "http", "https" }
local REPORTS = { [0] = "delivered", "sent", "failed", "returned", "moved" }
local PERFORMATIVES = {
    "accept-proposal", "agree", "cancel", "cfp", "confirm", "disconfirm", "failure", "inform", "inform-if",
    "inform-ref", "not-understood", "propagate", "propose", "proxy", "query-if", "query-ref", "refuse",
    "reject-proposal", "request", "request-when", "request-whenever", "subscribe",
}
local REPRESENTATIONS = {
    [0x10] = "fipa.acl.rep.bitefficient.std", [0x11] = "fipa.acl.rep.string.std", [0x12] = "fipa.acl.rep.xml.std",
}

local F = {}
do
    local function text(name, label)
        F[name] = ProtoField.string("fipa." .. name, label)
    end
    local function number(name, label, names, bits)
        local make = ProtoField["uint" .. (bits or 8)]
        F[name] = make("fipa." .. name, label, base.DEC, names)
    end
    local function hex(name, label)
        F[name] = ProtoField.uint64("fipa." .. name, label, base.HEX)
    end
    number("version", "Version")
    number("kind", "Kind of frame", FRAME_KINDS)
    number("flags", "Flags", nil, 16)
    number("number", "Number of the parcel", nil, 64)
    number("length", "Length of the body", nil, 64)

    number("datagram.kind", "Kind of datagram", DATAGRAM_KINDS)
    hex("datagram.to", "Connection at the receiver")
    hex("datagram.own", "Connection at the sender")
    number("datagram.packet", "Packet", nil, 64)
    number("datagram.frame", "Frame", PACKET_FRAMES)
    number("datagram.acknowledged", "Highest packet", nil, 64)
    number("datagram.delay", "Delay in µs", nil, 32)
    F["datagram.cookie"] = ProtoField.bytes("fipa.datagram.cookie", "Cookie")
    F["datagram.earlier"] = ProtoField.bytes("fipa.datagram.earlier", "Earlier packets, a bit each")

    text("hello.name", "Name of the service")
    text("hello.domain", "Domain")
    text("hello.host", "Host")
    hex("hello.incarnation", "Incarnation")
    number("hello.max_letter", "Largest letter", nil, 64)
    number("hello.max_in_flight", "Parcels in flight", nil, 32)
    number("hello.serial", "Serial number of the connection", nil, 64)
    text("hello.dialed", "Dialed location")
    text("hello.listening", "Listens on")
    F["hello.large"] = ProtoField.bool("fipa.hello.large", "For large letters")

    number("answer", "Answer", ANSWERS)
    number("answer.last", "Last accepted sequence", nil, 64)
    number("answer.reason", "Reason", REASONS)
    text("answer.detail", "Detail")
    number("answer.via", "Delivered by", TRANSPORTS)
    F["answer.uncertain"] = ProtoField.bool("fipa.answer.uncertain", "May have been delivered")

    number("parcel.kind", "Kind of parcel", PARCEL_KINDS)
    text("parcel.receiver", "Receiving agent")
    hex("parcel.realm", "Realm")
    hex("parcel.from", "Incarnation of the sender")
    hex("parcel.to", "Incarnation of the receiver")
    number("parcel.sequence", "Sequence", nil, 64)
    number("parcel.after", "After", nil, 64)
    number("parcel.transfer", "Hand-over", nil, 64)
    number("parcel.remaining", "Time to the deadline in µs", nil, 64)
    text("letter", "Identifier of the letter")

    number("report", "Report", REPORTS)
    number("report.via", "By", TRANSPORTS)
    number("report.reason", "Reason", REASONS)
    F["report.uncertain"] = ProtoField.bool("fipa.report.uncertain", "May have been delivered")
    text("report.attempt", "Attempt")

    text("envelope.representation", "acl-representation")
    text("envelope.date", "Date")
    text("envelope.to", "To")
    text("envelope.from", "From")
    text("envelope.intended_receiver", "Intended receiver")
    text("envelope.comments", "Comments")
    number("envelope.payload_length", "Payload length", nil, 64)
    text("envelope.payload_encoding", "Payload encoding")
    text("envelope.received_by", "Received by")
    text("envelope.received", "Received")
    text("envelope.behaviour", "Transport behaviour")
    text("envelope.user_defined", "User-defined parameter")

    text("encoding", "Encoding of the message")
    text("performative", "Performative")
    text("sender", "Sender")
    text("receiver", "Receiver")
    text("address", "Address")
    text("resolver", "Resolver")
    text("reply_to", "Reply to")
    text("reply_with", "Reply with")
    text("in_reply_to", "In reply to")
    text("reply_by", "Reply by")
    text("language", "Language")
    text("content_encoding", "Encoding of the content")
    text("ontology", "Ontology")
    text("protocol", "Protocol")
    text("conversation_id", "Conversation")
    text("user_defined", "User-defined parameter")
    number("content_length", "Length of the content", nil, 64)
    text("content", "Content")
    F["content_bytes"] = ProtoField.bytes("fipa.content_bytes", "Content, not printable")
    F["data"] = ProtoField.bytes("fipa.data", "Bytes without a frame")

    local all = {}
    for _, field in pairs(F) do
        all[#all + 1] = field
    end
    fipa.fields = all
end

local E = {
    malformed = ProtoExpert.new("fipa.malformed", "Malformed", expert.group.MALFORMED, expert.severity.ERROR),
    note = ProtoExpert.new("fipa.note", "Not dissected", expert.group.UNDECODED, expert.severity.NOTE),
    fault = ProtoExpert.new("fipa.fault", "Fault of the dissector", expert.group.MALFORMED, expert.severity.ERROR),
}
fipa.experts = { E.malformed, E.note, E.fault }

fipa.prefs.max_frame = Pref.uint("Largest reassembled frame (MiB)", 64, "Longer frames are shown without their body")
fipa.prefs.max_content = Pref.uint("Shown bytes of a content", 4096, "Longer contents are cut")

---------------------------------------------------------------------------------------------------------------------
-- Errors

local Malformed = {}

-- Ends the dissection of the current part. `is_short` says that it lacks bytes, `missing` how many, if that is known.
local function malformed(problem, is_short, missing)
    error(setmetatable({ problem = problem, is_short = is_short, missing = missing }, Malformed), 0)
end

local function is_malformed(failure)
    return getmetatable(failure) == Malformed
end

local items = 0

-- An item of the tree. All functions take the tree `nil`, which shows nothing.
local function item(tree, field, range, value, suffix)
    if not tree then
        return nil
    end
    items = items + 1
    if items > MAX_ITEMS then
        malformed("more than " .. MAX_ITEMS .. " items; the rest is not shown")
    end
    local added
    if value == nil then
        added = tree:add(field, range)
    else
        added = tree:add(field, range, value)
    end
    if suffix then
        added:append_text(suffix)
    end
    return added
end

local function item_le(tree, field, range)
    if not tree then
        return nil
    end
    return tree:add_le(field, range)
end

local function subtree(tree, range, label)
    if not tree then
        return nil
    end
    items = items + 1
    if items > MAX_ITEMS then
        malformed("more than " .. MAX_ITEMS .. " items; the rest is not shown")
    end
    return tree:add(range, label)
end

-- Calls a parser. Returns its result, or nil and the problem, which the tree shows.
local function guarded(tree, work, ...)
    local done, result = pcall(work, ...)
    if done then
        return result
    end
    local is_ours = is_malformed(result)
    local problem = is_ours and result.problem or "Fault of the dissector: " .. tostring(result)
    if tree then
        tree:add_proto_expert_info(is_ours and E.malformed or E.fault, problem)
    end
    return nil, is_ours and problem or "fault of the dissector"
end

---------------------------------------------------------------------------------------------------------------------
-- Texts

local MULTIBYTE = {
    "^[\xC2-\xDF][\x80-\xBF]", "^\xE0[\xA0-\xBF][\x80-\xBF]", "^[\xE1-\xEC\xEE\xEF][\x80-\xBF][\x80-\xBF]",
    "^\xED[\x80-\x9F][\x80-\xBF]", "^\xF0[\x90-\xBF][\x80-\xBF][\x80-\xBF]",
    "^[\xF1-\xF3][\x80-\xBF][\x80-\xBF][\x80-\xBF]", "^\xF4[\x80-\x8F][\x80-\xBF][\x80-\xBF]",
}
-- Characters that move or hide others: C1, marks of direction, separators of lines, the byte order mark.
local HIDDEN = { "^\xC2[\x80-\x9F]", "^\xE2\x80[\x8B-\x8F\xA8-\xAE]", "^\xE2\x81[\xA0-\xAF]", "^\xEF\xBB\xBF" }

local function escaped(bytes)
    return (bytes:gsub(".", function(byte)
        return ("\\x%02x"):format(byte:byte())
    end))
end

-- The length of the printable character of several bytes at this position, or nil.
local function character(text, at)
    for _, pattern in ipairs(HIDDEN) do
        if text:find(pattern, at) then
            return nil
        end
    end
    for _, pattern in ipairs(MULTIBYTE) do
        local first, last = text:find(pattern, at)
        if first then
            return last - first + 1
        end
    end
    return nil
end

-- The text with control characters and invalid UTF-8 escaped, and whether nothing was escaped but ends of lines.
local function clean(text)
    if not text:find("[^\x20-\x7e]") then
        return text, true
    end
    local out, at, printable = {}, 1, true
    while at <= #text do
        local first, last = text:find("^[\x20-\x7e]+", at)
        if first then
            out[#out + 1] = text:sub(first, last)
            at = last + 1
        else
            local byte = text:sub(at, at)
            local len = character(text, at)
            if len then
                out[#out + 1] = text:sub(at, at + len - 1)
                at = at + len
            elseif byte == "\n" or byte == "\r" or byte == "\t" then
                out[#out + 1] = ({ ["\n"] = "\\n", ["\r"] = "\\r", ["\t"] = "\\t" })[byte]
                at = at + 1
            else
                out[#out + 1] = escaped(byte)
                printable = false
                at = at + 1
            end
        end
    end
    return table.concat(out), printable
end

local function shown(text)
    if #text > MAX_SHOWN then
        return (clean(text:sub(1, MAX_SHOWN))) .. "…"
    end
    return (clean(text))
end

-- A text for the column of information.
local function brief(text)
    local limit = 60
    if #text <= limit then
        return (clean(text))
    end
    -- Not within a character.
    while limit > 1 and text:byte(limit + 1) >= 0x80 and text:byte(limit + 1) < 0xc0 do
        limit = limit - 1
    end
    return (clean(text:sub(1, limit))) .. "…"
end

---------------------------------------------------------------------------------------------------------------------
-- Reader: positions in a buffer. Offsets begin at 0; `stop` is the first offset behind the part.

local Reader = {}
Reader.__index = Reader

local function reader(tvb, at, stop)
    return setmetatable({ tvb = tvb, at = at, stop = math.min(stop, tvb:len()) }, Reader)
end

function Reader:left()
    return self.stop - self.at
end

function Reader:need(len, what)
    if len > self.stop - self.at then
        malformed(what .. " is cut off", true)
    end
end

-- The bytes without moving.
function Reader:peek(len, what)
    self:need(len, what)
    if len == 0 then
        return ""
    end
    return self.tvb:raw(self.at, len)
end

function Reader:take(len, what)
    local bytes = self:peek(len, what)
    self.at = self.at + len
    return bytes
end

function Reader:skip(len, what)
    self:need(len, what)
    self.at = self.at + len
end

function Reader:byte(what)
    return self:take(1, what):byte()
end

function Reader:take_if(byte)
    if self.at < self.stop and self.tvb:raw(self.at, 1):byte() == byte then
        self.at = self.at + 1
        return true
    end
    return false
end

-- An unsigned number of up to 6 bytes, exactly.
function Reader:big(len, what)
    local number = 0
    for _, byte in ipairs({ self:take(len, what):byte(1, len) }) do
        number = number * 256 + byte
    end
    return number
end

function Reader:little(len, what)
    local number, place = 0, 1
    for _, byte in ipairs({ self:take(len, what):byte(1, len) }) do
        number = number + byte * place
        place = place * 256
    end
    return number
end

-- A text that ends with a NUL.
function Reader:until_nul(what)
    local step = 256
    while true do
        local len = math.min(step, self.stop - self.at)
        local bytes = len > 0 and self.tvb:raw(self.at, len) or ""
        local nul = bytes:find("\0", 1, true)
        if nul then
            self.at = self.at + nul
            return bytes:sub(1, nul - 1)
        end
        if len == self.stop - self.at then
            malformed(what .. " has no end", true)
        elseif len >= MAX_TEXT then
            malformed(what .. " is longer than " .. MAX_TEXT .. " bytes")
        end
        step = step * 8
    end
end

-- The range from an earlier offset to here.
function Reader:since(start)
    return self:range(start, self.at - start)
end

-- A range that is always inside of the buffer.
function Reader:range(at, len)
    local size = self.tvb:len()
    if at >= size then
        at, len = size - 1, 0
    end
    return self.tvb:range(at, math.max(0, math.min(len, size - at)))
end

---------------------------------------------------------------------------------------------------------------------
-- Bit-efficient parts (FIPA00069, FIPA00088)

-- A `String 00` without quotation marks or byte count.
local function string_form(bytes)
    local inner = #bytes >= 2 and bytes:match('^"(.*)"$')
    if inner then
        return (inner:gsub('\\"', '"'))
    end
    local len, text = bytes:match('^#(%d%d?%d?%d?%d?%d?%d?%d?%d?%d?)"(.*)$')
    if len and tonumber(len) == #text then
        return text
    end
    return bytes
end

local DIGITS = {
    [1] = "0", [2] = "1", [3] = "2", [4] = "3", [5] = "4", [6] = "5", [7] = "6", [8] = "7", [9] = "8", [10] = "9",
    [12] = "+", [13] = "E", [14] = "-", [15] = ".",
}

-- `Digits`: two characters a byte, up to the first low nibble 0.
function Reader:digits(what)
    local out = {}
    while true do
        local byte = self:byte(what)
        local high, low = math.floor(byte / 16), byte % 16
        if high ~= 0 or low ~= 0 then
            out[#out + 1] = DIGITS[high] or malformed(what .. " has a wrong digit")
        end
        if low == 0 then
            return table.concat(out)
        end
        out[#out + 1] = DIGITS[low] or malformed(what .. " has a wrong digit")
        if #out > 4096 then
            malformed(what .. " is too long")
        end
    end
end

-- `BinDateTimeToken`.
function Reader:date(what)
    local SIGNS = { [0x20] = "", [0x21] = "+", [0x22] = "-", [0x24] = "", [0x25] = "+", [0x26] = "-" }
    local code = self:byte(what)
    local sign = SIGNS[code] or malformed(what .. " has the unknown code " .. code)
    local digits = {}
    for index, byte in ipairs({ self:take(9, what):byte(1, 9) }) do
        for _, nibble in ipairs({ math.floor(byte / 16), byte % 16 }) do
            local digit = nibble == 0 and "" or DIGITS[nibble]
            if not digit or digit:find("[^0-9]") then
                malformed(what .. " has a wrong digit")
            end
            digits[index] = (digits[index] or "") .. digit
        end
    end
    for index = 3, 7 do
        if #digits[index] < 2 then
            digits[index] = "0" .. digits[index]
        end
    end
    local zone = code >= 0x24 and self:take(1, what) or ""
    if code >= 0x24 and not zone:find("^[A-Za-z]$") then
        malformed(what .. " has a wrong zone")
    end
    local y1, y2, month, day, hour, minute, second, m1, m2 = table.unpack(digits)
    return ("%s%s%s-%s-%sT%s:%s:%s.%s%s%s"):format(sign, y1, y2, month, day, hour, minute, second, m1, m2, zone)
end

local function len_of_string(self, code, what)
    if code == 0x16 then
        return self:byte(what)
    elseif code == 0x17 then
        return self:big(2, what)
    end
    return self:big(4, what)
end

local function counted(self, code, what)
    local len = len_of_string(self, code, what)
    if len > MAX_TEXT then
        malformed(what .. " is longer than " .. MAX_TEXT .. " bytes")
    end
    return self:take(len, what)
end

local function literal(text)
    return '"' .. text:gsub('"', '\\"') .. '"'
end

-- `BinExpression`. The text of an expression in parentheses is that of FIPA00070.
function Reader:expression(what)
    local code = self:byte(what)
    if code == 0xff then
        code = self:byte(what)
    end
    if code == 0x10 then
        return self:until_nul(what)
    elseif code == 0x14 then
        return string_form(self:until_nul(what))
    elseif code == 0x16 or code == 0x17 or code == 0x19 then
        return counted(self, code, what)
    elseif code == 0x12 or code == 0x13 then
        return self:digits(what)
    end
    local out, depth = {}, 0
    local function token(text)
        if #out > 0 and out[#out] ~= "(" then
            out[#out + 1] = " "
        end
        out[#out + 1] = text
        if #out > 10000 then
            malformed(what .. " has too many parts")
        end
    end
    repeat
        local fused = code
        if code >= 0x60 and code <= 0x79 then
            token("(")
            depth = depth + 1
            fused = code == 0x60 and 0 or code - 0x60
            if fused == 0x18 then
                fused = 0x19
            end
        elseif code >= 0x40 and code <= 0x59 then
            out[#out + 1] = ")"
            depth = depth - 1
            fused = code == 0x40 and 0 or code - 0x40
            if fused == 0x18 then
                fused = 0x19
            end
        end
        if depth < 0 or depth > 64 then
            malformed(what .. " is nested wrongly")
        end
        if fused == 0x10 then
            token(self:until_nul(what))
        elseif fused == 0x12 or fused == 0x13 then
            token(self:digits(what))
        elseif fused == 0x14 then
            token(literal(string_form(self:until_nul(what))))
        elseif fused == 0x16 or fused == 0x17 or fused == 0x19 then
            token(literal(counted(self, fused, what)))
        elseif fused ~= 0 then
            malformed(("%s has the unknown code 0x%02x"):format(what, code))
        end
        code = depth > 0 and self:byte(what) or nil
    until not code
    return table.concat(out)
end

-- `BinWord`.
function Reader:word(what)
    local code = self:byte(what)
    if code ~= 0x10 then
        malformed(("%s begins with 0x%02x, not with a word"):format(what, code))
    end
    return self:until_nul(what)
end

-- The two notations of agent identifiers: of messages, and of envelopes.
local IN_MESSAGES = {
    text = Reader.word,
    user_defined = function(self, code)
        if code ~= 0x04 then
            return nil
        end
        local name = self:word("name of a parameter")
        -- JADE writes an empty value as 00.
        return name, self:take_if(0x00) and "" or self:expression("value of a parameter")
    end,
}
local IN_ENVELOPES = {
    text = function(self, what)
        return string_form(self:until_nul(what))
    end,
    user_defined = function(self, code)
        if code ~= 0x04 and code ~= 0x05 then
            return nil
        end
        local name = string_form(self:until_nul("name of a parameter"))
        if code == 0x04 then
            return name, string_form(self:until_nul("value of a parameter"))
        end
        local first = self:byte("value of a parameter")
        if first == 0x14 then
            return name, string_form(self:until_nul("value of a parameter"))
        elseif first == 0x16 or first == 0x17 or first == 0x19 then
            return name, counted(self, first, "value of a parameter")
        end
        malformed("value of a parameter is no text")
    end,
}

-- An agent identifier: shows it as `field`, and returns its name.
function Reader:agent(tree, field, notation, depth)
    depth = depth or 0
    if depth > MAX_DEPTH then
        malformed("agent identifiers are nested too deep")
    end
    local start = self.at
    local code = self:byte("agent identifier")
    if code ~= 0x02 then
        malformed(("agent identifier begins with 0x%02x"):format(code))
    end
    local name = notation.text(self, "name of an agent")
    local added = item(tree, field, self:since(start), shown(name))
    while true do
        start = self.at
        code = self:byte("agent identifier")
        if code == 0x01 then
            break
        elseif code == 0x02 then
            while not self:take_if(0x01) do
                start = self.at
                local address = notation.text(self, "address of an agent")
                item(added, F.address, self:since(start), shown(address))
            end
        elseif code == 0x03 then
            while not self:take_if(0x01) do
                self:agent(added, F.resolver, notation, depth + 1)
            end
        else
            local key, value = notation.user_defined(self, code)
            if not key then
                malformed(("agent identifier has the unknown part 0x%02x"):format(code))
            end
            item(added, F.user_defined, self:since(start), shown(key .. "=" .. value))
        end
    end
    return name
end

-- A set of agent identifiers. Returns the names.
function Reader:agents(tree, field, notation)
    local names = {}
    while not self:take_if(0x01) do
        names[#names + 1] = self:agent(tree, field, notation)
    end
    return names
end

-- Shows a content at this range: as text if it is printable, else as bytes. `whole` is its length if the capture has
-- only a part of it.
local function show_content(tree, tvb, at, len, whole)
    if not tree then
        return
    end
    whole = whole or len
    tree:add(F.content_length, UInt64.new(whole % 4294967296, math.floor(whole / 4294967296))):set_generated()
    if len == 0 then
        return
    end
    local limit = math.min(len, fipa.prefs.max_content)
    if limit == 0 then
        return
    end
    local bytes = tvb:raw(at, limit)
    local cut = limit < whole
    if cut then
        -- A character may be cut.
        bytes = bytes:gsub("[\xC2-\xF4][\x80-\xBF]?[\x80-\xBF]?$", "")
    end
    local text, printable = clean(bytes)
    if printable then
        item(tree, F.content, tvb:range(at, len), text .. (cut and "…" or ""))
    else
        item(tree, F.content_bytes, tvb:range(at, limit))
    end
end

local TEXT_PARAMETERS = {
    [0x05] = "reply_with", [0x07] = "in_reply_to", [0x09] = "language", [0x0a] = "content_encoding",
    [0x0b] = "ontology", [0x0d] = "conversation_id",
}

-- A bit-efficient message. Returns what the column of information needs.
local function bit_efficient(self, tree)
    local found = { receivers = {}, content_length = 0 }
    local first = self:byte("message")
    item(tree, F.encoding, self:range(self.at - 1, 1), "bit-efficient")
    if first ~= 0xfa then
        found.note = "a message with code tables (FIPA00069 2.3)"
    end
    self:byte("version of the message")
    local start = self.at
    local act = self:byte("performative")
    found.performative = PERFORMATIVES[act]
    if act == 0 then
        if found.note then
            return found
        end
        found.performative = self:word("performative")
    elseif not found.performative then
        malformed("unknown performative " .. act)
    end
    item(tree, F.performative, self:since(start), shown(found.performative))
    if found.note then
        return found
    end
    while true do
        start = self.at
        local code = self:byte("message")
        local name = TEXT_PARAMETERS[code]
        if code == 0x01 then
            return found
        elseif name then
            found[name] = self:expression(name)
            item(tree, F[name], self:since(start), shown(found[name]))
        elseif code == 0x00 then
            local key = self:word("name of a parameter")
            local value = self:take_if(0x00) and "" or self:expression("value of a parameter")
            item(tree, F.user_defined, self:since(start), shown(key .. "=" .. value))
        elseif code == 0x02 then
            found.sender = self:agent(tree, F.sender, IN_MESSAGES)
        elseif code == 0x03 then
            found.receivers = self:agents(tree, F.receiver, IN_MESSAGES)
        elseif code == 0x08 then
            self:agents(tree, F.reply_to, IN_MESSAGES)
        elseif code == 0x06 then
            local date = self:date("reply-by")
            item(tree, F.reply_by, self:since(start), date)
        elseif code == 0x0c then
            found.protocol = self:word("protocol")
            item(tree, F.protocol, self:since(start), shown(found.protocol))
        elseif code == 0x04 then
            local form = self:byte("content")
            local at, len
            if form == 0x16 or form == 0x17 or form == 0x19 then
                len = len_of_string(self, form, "content")
                at = self.at
                if len > self:left() and self.is_cut then
                    found.content_length = len
                    show_content(tree, self.tvb, at, self:left(), len)
                    return found
                end
                self:skip(len, "content")
            elseif form == 0x14 then
                at = self.at
                len = #self:until_nul("content")
            else
                self.at = self.at - 1
                at = self.at
                self:expression("content")
                len = self.at - at
            end
            found.content_length = len
            show_content(tree, self.tvb, at, len)
        else
            malformed(("message has the unknown parameter 0x%02x"):format(code))
        end
    end
end

---------------------------------------------------------------------------------------------------------------------
-- Messages as text (FIPA00070, FIPA00071)

local KEYS = {
    ["reply-with"] = "reply_with", ["in-reply-to"] = "in_reply_to", ["reply-by"] = "reply_by",
    language = "language", encoding = "content_encoding", ontology = "ontology", protocol = "protocol",
    ["conversation-id"] = "conversation_id",
}

-- The position of a text in bytes, and its text without quotation marks: a word, a literal, or an expression.
local function value_at(text, at)
    local first = text:sub(at, at)
    if first == '"' then
        local stop = at
        repeat
            stop = text:find('"', stop + 1, true)
            if not stop then
                malformed("a text has no closing quotation mark", true)
            end
        until text:sub(stop - 1, stop - 1) ~= "\\" or text:sub(stop - 2, stop - 2) == "\\"
        return stop + 1, (text:sub(at + 1, stop - 1):gsub('\\"', '"')), at, stop - at - 1
    elseif first == "#" then
        local _, mark, len = text:find('^#(%d%d?%d?%d?%d?%d?%d?%d?%d?)"', at)
        len = tonumber(len)
        if not len or mark + len > #text then
            malformed("a text with a byte count is cut off", true)
        end
        return mark + len + 1, text:sub(mark + 1, mark + len), mark, len
    elseif first == "(" then
        local depth, stop = 0, at
        repeat
            local from = text:find('[()"#]', stop)
            local char = from and text:sub(from, from) or malformed("a parenthesis is not closed", true)
            if char == "(" then
                depth, stop = depth + 1, from + 1
            elseif char == ")" then
                depth, stop = depth - 1, from + 1
            elseif char == "#" and not text:find('^#%d+"', from) then
                stop = from + 1
            else
                stop = value_at(text, from)
            end
        until depth == 0
        return stop, text:sub(at, stop - 1), at - 1, stop - at
    end
    local _, last = text:find("^[^%s()]+", at)
    if not last then
        malformed("a value is missing", true)
    end
    return last + 1, text:sub(at, last), at - 1, last - at + 1
end

-- The names of the agents in an expression.
local function names_in(text)
    local names, at = {}, 1
    while #names < 1000 do
        local _, last = text:find(":name%s+", at)
        if not last then
            break
        end
        local next_at, name = value_at(text, last + 1)
        names[#names + 1] = name
        at = next_at
    end
    return names
end

local function string_message(self, tree)
    local base_at = self.at
    if self:left() > MAX_TEXT then
        malformed("message is longer than " .. MAX_TEXT .. " bytes")
    end
    local text = self:take(self:left(), "message")
    item(tree, F.encoding, self:range(base_at, 1), "string")
    local first, last, act = text:find("^[%s\xEF\xBB\xBF]*%(%s*([^%s()]+)")
    if not first then
        malformed("a message as text has no performative", true)
    end
    local found = { receivers = {}, content_length = 0, performative = act:lower() }
    item(tree, F.performative, self:range(base_at + last - #act, #act), shown(found.performative))
    local at = last + 1
    while true do
        at = text:find("%S", at) or malformed("a message as text has no end", true)
        if text:sub(at, at) == ")" then
            return found
        end
        local _, key_end, key = text:find("^:([^%s()]+)%s*", at)
        if not key then
            malformed("a parameter of a message as text has no name")
        end
        local stop, value, from, len = value_at(text, key_end + 1)
        local range = self:range(base_at + at - 1, stop - at)
        key = key:lower()
        if key == "sender" or key == "receiver" or key == "reply-to" then
            local names = names_in(value)
            local field = key == "reply-to" and F.reply_to or F[key]
            for _, name in ipairs(names) do
                item(tree, field, range, shown(name))
            end
            if key == "sender" then
                found.sender = names[1]
            elseif key == "receiver" then
                found.receivers = names
            end
        elseif key == "content" then
            found.content_length = len
            show_content(tree, self.tvb, base_at + from, len)
        elseif KEYS[key] then
            found[KEYS[key]] = value
            item(tree, F[KEYS[key]], range, shown(value))
        else
            item(tree, F.user_defined, range, shown(key .. "=" .. value))
        end
        at = stop
    end
end

local ENTITIES = { amp = "&", lt = "<", gt = ">", quot = '"', apos = "'" }

local function unescaped(text)
    return (text:gsub("&(%a+);", ENTITIES))
end

local function xml_message(self, tree)
    local base_at = self.at
    if self:left() > MAX_TEXT then
        malformed("message is longer than " .. MAX_TEXT .. " bytes")
    end
    local text = self:take(self:left(), "message")
    item(tree, F.encoding, self:range(base_at, 1), "XML")
    local first, last = text:find("<fipa%-message[^>]*>")
    if not first then
        malformed("XML without a fipa-message", true)
    end
    local head = text:sub(first, last)
    local found = { receivers = {}, content_length = 0 }
    local act = head:match('%sact%s*=%s*"([^"]*)"') or malformed("a message without act")
    found.performative = unescaped(act):lower()
    item(tree, F.performative, self:range(base_at + first - 1, last - first + 1), shown(found.performative))
    local at = last + 1
    while true do
        local open, open_end, key, attributes = text:find("<([%w%-]+)([^>]*)>", at)
        local close = text:find("</fipa-message", at, true)
        if not close then
            malformed("XML has no end", true)
        elseif not open or close < open then
            return found
        end
        local inner, inner_len, stop = "", 0, open_end
        if attributes:sub(-1) ~= "/" then
            local ending, ending_last = text:find("</" .. key:gsub("%-", "%%-") .. "%s*>", open_end + 1)
            if not ending then
                malformed("the element " .. key:sub(1, 40) .. " has no end", true)
            end
            inner, inner_len, stop = text:sub(open_end + 1, ending - 1), ending - open_end - 1, ending_last
        end
        local range = self:range(base_at + open - 1, stop - open + 1)
        if key == "sender" or key == "receiver" or key == "reply-to" then
            local field = key == "reply-to" and F.reply_to or F[key]
            for name in inner:gmatch("<name([^>]*>[^<]*)") do
                name = unescaped(name:match('id%s*=%s*"([^"]*)"') or name:match(">(.*)$"))
                item(tree, field, range, shown(name))
                if key == "sender" then
                    found.sender = found.sender or name
                elseif key == "receiver" then
                    found.receivers[#found.receivers + 1] = name
                end
            end
        elseif key == "content" then
            found.content_length = inner_len
            show_content(tree, self.tvb, base_at + open_end, inner_len)
        elseif KEYS[key] then
            local value = inner ~= "" and inner or attributes:match('="([^"]*)"') or ""
            found[KEYS[key]] = unescaped(value)
            item(tree, F[KEYS[key]], range, shown(found[KEYS[key]]))
        else
            local name = attributes:match('href%s*=%s*"([^"]*)"') or key
            item(tree, F.user_defined, range, shown(unescaped(name) .. "=" .. unescaped(inner)))
        end
        at = stop + 1
    end
end

-- A message in any encoding, up to the end of the reader.
local function message(self, tree)
    local bytes = self:peek(math.min(self:left(), 256), "message")
    if bytes:find("^[\xfa-\xfc]") then
        return bit_efficient(self, tree)
    end
    local first = bytes:match("^[%s\xEF\xBB\xBF]*([(<])")
    if first == "(" then
        return string_message(self, tree)
    elseif first == "<" then
        return xml_message(self, tree)
    end
    malformed("the encoding of the message is unknown")
end

---------------------------------------------------------------------------------------------------------------------
-- Envelopes (FIPA00088)

local function representation(self, tree, field)
    local start = self.at
    local name = REPRESENTATIONS[self:peek(1, "acl-representation"):byte()]
    if name then
        self.at = self.at + 1
    else
        self:take_if(0x00)
        name = string_form(self:until_nul("acl-representation"))
    end
    item(tree, field, self:since(start), shown(name))
    return name
end

local function stamp(self, tree)
    local start = self.at
    local by = string_form(self:until_nul("received-by"))
    local added = item(tree, F["envelope.received_by"], self:since(start), shown(by))
    start = self.at
    local date = self:date("received-date")
    item(added, F["envelope.received"], self:since(start), "date " .. date)
    local PARTS = { [0x02] = "from", [0x03] = "id", [0x04] = "via" }
    while true do
        start = self.at
        local code = self:byte("stamp")
        if code == 0x01 then
            return
        elseif code == 0x00 then
            local name = string_form(self:until_nul("name of a parameter"))
            local value = name:find(" ", 1, true) and "" or "=" .. string_form(self:until_nul("value of a parameter"))
            item(added, F["envelope.user_defined"], self:since(start), shown(name .. value))
        elseif PARTS[code] then
            local text = string_form(self:until_nul("received-" .. PARTS[code]))
            item(added, F["envelope.received"], self:since(start), shown(PARTS[code] .. " " .. text))
        else
            malformed(("stamp has the unknown part 0x%02x"):format(code))
        end
    end
end

-- Parameters of one envelope up to its end.
local function envelope_parameters(self, tree, found)
    local TEXTS = { [0x05] = "comments", [0x07] = "payload_encoding" }
    while true do
        local start = self.at
        local code = self:byte("envelope")
        if code == 0x01 then
            return
        elseif code == 0x00 then
            local name = string_form(self:until_nul("name of a parameter"))
            local value = name:find(" ", 1, true) and "" or "=" .. string_form(self:until_nul("value of a parameter"))
            item(tree, F["envelope.user_defined"], self:since(start), shown(name .. value))
        elseif code == 0x02 then
            self:agents(tree, F["envelope.to"], IN_ENVELOPES)
        elseif code == 0x03 then
            self:agent(tree, F["envelope.from"], IN_ENVELOPES)
        elseif code == 0x04 then
            representation(self, tree, F["envelope.representation"])
        elseif TEXTS[code] then
            local text = string_form(self:until_nul(TEXTS[code]))
            item(tree, F["envelope." .. TEXTS[code]], self:since(start), shown(text))
        elseif code == 0x06 then
            -- fipa_services writes the code of a number.
            local next_byte = self:peek(1, "payload-length"):byte()
            if next_byte == 0x12 or next_byte == 0x13 then
                self.at = self.at + 1
            end
            local digits = self:digits("payload-length")
            local len = digits:find("^%d+$") and #digits <= 15 and tonumber(digits)
            if not len then
                malformed("payload-length is no length")
            end
            found.payload_length = len
            local value = UInt64.new(len % 4294967296, math.floor(len / 4294967296))
            item(tree, F["envelope.payload_length"], self:since(start), value)
        elseif code == 0x09 then
            self:agents(tree, F["envelope.intended_receiver"], IN_ENVELOPES)
        elseif code == 0x0a then
            stamp(self, tree)
        elseif code == 0x0b then
            local form = self:byte("transport-behaviour")
            local text
            if form == 0x14 then
                text = string_form(self:until_nul("transport-behaviour"))
            elseif form == 0x16 or form == 0x17 or form == 0x19 then
                text = counted(self, form, "transport-behaviour")
            else
                malformed("transport-behaviour is no text")
            end
            item(tree, F["envelope.behaviour"], self:since(start), shown(text))
        else
            malformed(("envelope has the unknown parameter 0x%02x"):format(code))
        end
    end
end

-- All envelopes of a letter. Returns what the letter needs of them.
local function envelope(self, tree, found)
    found = found or {}
    for _ = 1, 1024 do
        local start = self.at
        local code = self:byte("envelope")
        if code ~= 0xfd and code ~= 0xfe then
            malformed(("envelope begins with 0x%02x"):format(code))
        end
        local is_base = code == 0xfe
        local label = is_base and "Envelope" or "Envelope, extension"
        if self:big(2, "length of the envelope") == 0 then
            self:big(4, "length of the envelope")
        end
        local branch = subtree(tree, self:range(start, self:left()), label)
        if is_base then
            found.representation = representation(self, branch, F["envelope.representation"])
            local at = self.at
            local date = self:date("date")
            item(branch, F["envelope.date"], self:since(at), date)
        else
            -- JADE writes the code of a stamp.
            self:take_if(0x0a)
            stamp(self, branch)
        end
        found.has_date = true
        envelope_parameters(self, branch, found)
        if branch then
            branch:set_len(self.at - start)
        end
        if is_base then
            return found
        end
    end
    malformed("more than 1024 envelopes")
end

---------------------------------------------------------------------------------------------------------------------
-- Parcels, answers, hellos

local function summary(found)
    if not found.performative then
        return "letter"
    end
    local receivers = {}
    for index, name in ipairs(found.receivers) do
        if index > 3 then
            receivers[index] = "…"
            break
        end
        receivers[index] = brief(name)
    end
    local parts = {}
    parts[1] = ("%s %s → %s"):format(
        brief(found.performative),
        found.sender and brief(found.sender) or "?",
        #receivers > 0 and table.concat(receivers, " ") or "?"
    )
    if found.protocol then
        parts[#parts + 1] = brief(found.protocol)
    end
    if found.conversation_id then
        parts[#parts + 1] = "conversation " .. brief(found.conversation_id)
    end
    parts[#parts + 1] = ("%.0f bytes"):format(found.content_length)
    return table.concat(parts, ", ")
end

-- Shows a message and what of it is not dissected. Returns its summary.
local function show_message(tvb, tree, at, stop, is_cut)
    local range = tvb:range(at, stop - at)
    local branch = subtree(tree, range, "Message")
    local self = reader(tvb, at, stop)
    -- The capture lacks the rest.
    self.is_cut = is_cut
    local found, problem = guarded(branch, message, self, branch)
    if not found then
        return "malformed message: " .. problem, true
    end
    if found.note and branch then
        branch:add_proto_expert_info(E.note, found.note)
    end
    if branch then
        branch:append_text(": " .. summary(found))
    end
    return summary(found)
end

local function answer(self, tree)
    local start = self.at
    local code = self:byte("answer")
    local name = ANSWERS[code] or malformed("unknown answer " .. code)
    item(tree, F.answer, self:since(start))
    if code == 3 then
        item_le(tree, F["answer.last"], self:range(self.at, 8))
        self:skip(8, "last accepted sequence")
    elseif code == 4 then
        local reason = self:byte("reason")
        item(tree, F["answer.reason"], self:range(self.at - 1, 1))
        start = self.at
        local detail = self:take(self:left(), "detail")
        item(tree, F["answer.detail"], self:since(start), shown(detail))
        return ("failed, %s: %s"):format(REASONS[reason] or malformed("unknown reason " .. reason), brief(detail))
    elseif code == 5 then
        item(tree, F["answer.uncertain"], self:range(self.at, 1))
        self:skip(1, "answer")
    elseif code == 7 then
        local via = self:byte("transport")
        item(tree, F["answer.via"], self:range(self.at - 1, 1))
        return "delivered by " .. (TRANSPORTS[via] or malformed("unknown transport " .. via))
    end
    if self:left() > 0 then
        malformed("answer is too long")
    end
    return name
end

local function text16(self, what)
    return self:take(self:little(2, what), what)
end

local function report(self, tree)
    local start = self.at
    local tag, code = self:byte("report"), self:byte("report")
    local name = REPORTS[tag] or malformed("unknown report " .. tag)
    item(tree, F.report, self:range(start, 1))
    if tag == 3 then
        item(tree, F["report.uncertain"], self:range(start + 1, 1))
    elseif tag == 2 then
        item(tree, F["report.reason"], self:range(start + 1, 1))
        name = name .. ", " .. (REASONS[code] or malformed("unknown reason " .. code))
    elseif tag < 2 then
        item(tree, F["report.via"], self:range(start + 1, 1))
        name = name .. " by " .. (TRANSPORTS[code] or malformed("unknown transport " .. code))
    end
    if tag < 3 then
        local count = self:byte("attempts")
        if count > 32 then
            malformed("more than 32 attempts")
        end
        for _ = 1, count do
            local at = self.at
            local via, fault = self:byte("attempt"), self:byte("attempt")
            local location = text16(self, "location")
            local detail = text16(self, "detail")
            local kind = FAULTS[fault] or malformed("unknown fault " .. fault)
            local line = ("%s %s: %s, %s"):format(TRANSPORTS[via] or via, location, kind, detail)
            item(tree, F["report.attempt"], self:since(at), shown(line))
        end
    end
    if self:left() > 0 then
        malformed("report is too long")
    end
    return name
end

local function hex64(range)
    local value = range:le_uint64()
    return ("%08x%08x"):format(value:higher(), value:lower())
end

-- A parcel up to the end of the reader.
local function parcel(self, tree, parent)
    self:need(PARCEL_HEADER, "parcel")
    local tvb, at = self.tvb, self.at
    local kind = tvb:range(at, 1):uint()
    local name_len = tvb:range(at + 2, 2):le_uint()
    local envelope_len = tvb:range(at + 4, 4):le_uint()
    local head_len = tvb:range(at + 8, 4):le_uint()
    local tail_len = tvb:range(at + 12, 4):le_uint()
    local content_len = tvb:range(at + 16, 8):le_uint64():tonumber()
    item(tree, F["parcel.kind"], tvb:range(at, 1))
    for index, name in ipairs({ "realm", "from", "to", "sequence", "after", "transfer", "remaining" }) do
        item_le(tree, F["parcel." .. name], tvb:range(at + 16 + 8 * index, 8))
    end
    local sequence = tvb:range(at + 48, 8):le_uint64()
    local id = hex64(tvb:range(at + 32, 8)) .. "-" .. tostring(sequence)
    if tree then
        item(tree, F.letter, tvb:range(at + 32, 24), id):set_generated()
    end
    self.at = at + PARCEL_HEADER
    local announced = name_len + envelope_len + head_len + tail_len + content_len
    if announced ~= self:left() and not (self.is_cut and announced > self:left()) then
        malformed(("parcel announces %.0f bytes, and there are %d"):format(announced, self:left()))
    end
    local start = self.at
    local receiver = self:take(name_len, "receiving agent")
    item(tree, F["parcel.receiver"], self:since(start), shown(receiver))
    if kind == 2 then
        local told = report(self, tree)
        return ("report for %s: %s"):format(brief(receiver), told)
    elseif kind == 3 or kind == 4 then
        if self:left() > 0 then
            malformed("parcel is too long")
        end
        return PARCEL_KINDS[kind] .. " for " .. brief(receiver)
    elseif kind ~= 1 then
        malformed("unknown kind of parcel " .. kind)
    end
    start = self.at
    local stop = start + envelope_len
    guarded(parent, envelope, reader(tvb, start, stop), parent)
    if stop >= self.stop then
        local is_cut = self.is_cut and head_len + tail_len + content_len > 0
        if is_cut then
            return "letter for " .. brief(receiver) .. ", cut off"
        end
        return "letter for " .. brief(receiver) .. " without a message"
    end
    return (show_message(tvb, parent, stop, self.stop, self.is_cut))
end

local function hello(self, tree)
    local at = self.at
    self:skip(28, "hello")
    item_le(tree, F["hello.incarnation"], self:range(at, 8))
    item_le(tree, F["hello.max_letter"], self:range(at + 8, 8))
    item_le(tree, F["hello.max_in_flight"], self:range(at + 16, 4))
    item_le(tree, F["hello.serial"], self:range(at + 20, 8))
    local texts = {}
    for _, name in ipairs({ "name", "domain", "host", "dialed" }) do
        at = self.at
        texts[name] = text16(self, name)
        item(tree, F["hello." .. name], self:since(at), shown(texts[name]))
    end
    local count = self:byte("number of addresses")
    if count > 16 then
        malformed("more than 16 addresses")
    end
    for _ = 1, count do
        at = self.at
        local address = text16(self, "address")
        item(tree, F["hello.listening"], self:since(at), shown(address))
    end
    if self:left() > 0 and self:peek(1, "hello"):byte() == 1 then
        item(tree, F["hello.large"], self:range(self.at, 1))
    end
    return ("hello of %s on %s, domain %s"):format(brief(texts.name), brief(texts.host), brief(texts.domain))
end

---------------------------------------------------------------------------------------------------------------------
-- Frames on streams

-- Whether bytes from this offset can be the start of a frame. All versions have the same first eight bytes.
local function begins_frame(tvb, at)
    local len = math.min(tvb:len() - at, COMMON)
    if len <= 0 then
        return false
    end
    local bytes = tvb:raw(at, len)
    local magic = math.min(len, #MAGIC)
    if bytes:sub(1, magic) ~= MAGIC:sub(1, magic) then
        return false
    end
    local version, kind = bytes:byte(5), bytes:byte(6)
    return (not version or (version >= 1 and version <= 32)) and (not kind or (kind >= 1 and kind <= 6))
end

-- The offset of the next start of a frame behind this offset, or the end.
local function next_frame(tvb, at)
    local bytes = tvb:raw(at, tvb:len() - at)
    local from = 2
    while true do
        local found = bytes:find(MAGIC, from, true)
        if not found then
            return tvb:len()
        end
        if tvb:len() - (at + found - 1) >= COMMON and begins_frame(tvb, at + found - 1) then
            return at + found - 1
        end
        from = found + 1
    end
end

-- One frame whose bytes end at `stop`. Returns its summary.
local function frame(tvb, root, at, stop, announced)
    local self = reader(tvb, at, stop)
    local tree = root:add(fipa, self:range(at, stop - at))
    item(tree, F.version, tvb:range(at + 4, 1))
    item(tree, F.kind, tvb:range(at + 5, 1))
    item_le(tree, F.flags, tvb:range(at + 6, 2))
    item_le(tree, F.number, tvb:range(at + 8, 8))
    item_le(tree, F.length, tvb:range(at + 16, 8))
    local version, kind = tvb:range(at + 4, 1):uint(), tvb:range(at + 5, 1):uint()
    if version ~= VERSION then
        tree:add_proto_expert_info(E.note, "frames of version " .. version .. " are not dissected")
        return "frame of version " .. version
    end
    local number = tostring(tvb:range(at + 8, 8):le_uint64())
    local name = FRAME_KINDS[kind] or ("frame of kind " .. kind)
    self.at = at + FRAME_HEADER
    if announced > self:left() then
        self.is_cut = true
        local note = "the frame has %.0f bytes, of which %d are there"
        tree:add_proto_expert_info(E.note, note:format(announced, self:left()))
    end
    local text, problem
    if kind == 2 then
        text, problem = guarded(tree, parcel, self, tree, tree)
    elseif kind == 1 then
        text, problem = guarded(tree, hello, self, tree)
    elseif kind == 3 then
        text, problem = guarded(tree, answer, self, tree)
        text = text and ("answer to %s: %s"):format(number, text)
    elseif FRAME_KINDS[kind] then
        text = kind == 6 and "goodbye after " .. number or name
        if announced > 0 then
            tree:add_proto_expert_info(E.malformed, name .. " has a body")
        end
    else
        tree:add_proto_expert_info(E.malformed, "unknown kind of frame " .. kind)
        text = name
    end
    text = text or ("malformed %s: %s"):format(name, problem)
    tree:append_text(", " .. text)
    return text
end

local Info = {}
Info.__index = Info

local function info_of()
    return setmetatable({ parts = {} }, Info)
end

function Info:add(text)
    local count = #self.parts
    if count < MAX_INFO then
        self.parts[count + 1] = text
    elseif count == MAX_INFO then
        self.parts[count + 1] = "…"
    end
end

-- Shows the summaries. A packet may have several streams, each with its own call.
local last_packet, last_info

function Info:show(pinfo)
    if #self.parts == 0 then
        return
    end
    pinfo.cols.protocol = "FIPA"
    local text = table.concat(self.parts, " | ")
    local written = tostring(pinfo.cols.info)
    if last_packet == pinfo.number and written == last_info then
        text = last_info .. " | " .. text
    end
    pinfo.cols.info:set(text)
    last_packet, last_info = pinfo.number, tostring(pinfo.cols.info)
end

local function wait_for(pinfo, at, len)
    pinfo.desegment_offset = at
    pinfo.desegment_len = len
end

local UDP = 3

-- Whether the dissector gets the bytes again when more have arrived. Wireshark 4.0 does not reassemble the streams of
-- QUIC for dissectors in Lua.
local function can_wait(tvb, pinfo)
    if pinfo.port_type == UDP then
        return false
    end
    local can = pinfo.can_desegment
    return can and can ~= 0 and tvb:len() == tvb:reported_len()
end

-- Dissects the bytes of a stream. Returns the number of bytes that were used.
local function stream(tvb, pinfo, root)
    local size = tvb:len()
    local waits, info, at = can_wait(tvb, pinfo), info_of(), 0
    items = 0
    while at < size do
        if not begins_frame(tvb, at) then
            -- A capture that began within a frame, or lost bytes.
            local stop = next_frame(tvb, at)
            local tree = root:add(fipa, tvb:range(at, stop - at), "FIPA letters, bytes without the start of a frame")
            tree:add(F.data, tvb:range(at, math.min(stop - at, 4096)))
            info:add(("%d bytes without the start of a frame"):format(stop - at))
            at = stop
        elseif size - at < FRAME_HEADER then
            if waits then
                wait_for(pinfo, at, ONE_MORE_SEGMENT)
            else
                local tree = root:add(fipa, tvb:range(at, size - at), "FIPA letters, start of a frame")
                tree:add(F.data, tvb:range(at, size - at))
            end
            info:add("start of a frame")
            break
        else
            local announced = tvb:range(at + 16, 8):le_uint64():tonumber()
            local stop = at + FRAME_HEADER + announced
            local is_dissected = tvb:range(at + 4, 1):uint() == VERSION
            if stop > size and waits and is_dissected and announced <= fipa.prefs.max_frame * 1048576 then
                wait_for(pinfo, at, stop - size)
                info:add("part of a frame")
                break
            end
            info:add(frame(tvb, root, at, math.min(stop, size), announced))
            at = math.min(stop, size)
        end
    end
    info:show(pinfo)
    return size
end

---------------------------------------------------------------------------------------------------------------------
-- Letters without frames (transport-net/src/legacy)

-- One letter from this offset. Returns its summary and the offset behind it, or nil and the missing bytes.
local function bare_letter(tvb, tree, at)
    local self = reader(tvb, at, tvb:len())
    local found = envelope(self, tree)
    local stop = found.payload_length and self.at + found.payload_length
    if not stop then
        local ahead = reader(tvb, self.at, tvb:len())
        message(ahead, nil)
        stop = ahead.at
    elseif stop > tvb:len() then
        malformed("letter is cut off", true, stop - tvb:len())
    end
    local text = "letter without a message"
    if stop > self.at then
        text = show_message(tvb, tree, self.at, stop)
    end
    return { text = text, stop = stop }
end

local function letters(tvb, pinfo, root)
    local size = tvb:len()
    local waits, info, at = can_wait(tvb, pinfo), info_of(), 0
    items = 0
    while at < size do
        local done, result = pcall(bare_letter, tvb, nil, at)
        local is_short = not done and is_malformed(result) and result.is_short
        if is_short and waits and size - at <= fipa.prefs.max_frame * 1048576 then
            wait_for(pinfo, at, result.missing or ONE_MORE_SEGMENT)
            info:add("part of a letter")
            break
        end
        local tree = root:add(fipa, tvb:range(at, size - at), "FIPA letter without a frame")
        local shown_letter, problem = guarded(tree, bare_letter, tvb, tree, at)
        if not shown_letter then
            info:add("malformed letter: " .. problem)
            break
        end
        tree:set_len(shown_letter.stop - at)
        tree:append_text(", " .. shown_letter.text)
        info:add(shown_letter.text)
        at = shown_letter.stop
    end
    info:show(pinfo)
    return size
end

-- Whether the bytes begin a letter without a frame: at least the first stamp, or representation and date, are there.
local function begins_letter(tvb)
    local first = tvb:raw(0, 1):byte()
    if first ~= 0xfd and first ~= 0xfe then
        return false
    end
    local found = {}
    local done, failure = pcall(envelope, reader(tvb, 0, tvb:len()), nil, found)
    return done or (found.has_date and is_malformed(failure) and failure.is_short) or false
end

---------------------------------------------------------------------------------------------------------------------
-- Datagrams

local function counted_hello(self, tree)
    local len = self:little(2, "length of the hello")
    self:need(len, "hello")
    return hello(reader(self.tvb, self.at, self.at + len), tree)
end

local function packet(self, tree, info)
    item_le(tree, F["datagram.packet"], self:range(self.at, 8))
    self:skip(8, "number of the packet")
    while self:left() > 0 do
        local start = self.at
        local kind = self:byte("frame")
        local branch = subtree(tree, self:range(start, self:left()), "Frame")
        item(branch, F["datagram.frame"], self:range(start, 1))
        local function number(field, what)
            item_le(branch, field, self:range(self.at, 8))
            local value = tostring(self:range(self.at, 8):le_uint64())
            self:skip(8, what)
            return value
        end
        self:need(kind >= 1 and kind <= 6 and kind ~= 4 and 8 or 0, "frame")
        if kind == 0 then
            self.at = self.stop
        elseif kind == 1 then
            local largest = number(F["datagram.acknowledged"], "highest packet")
            item_le(branch, F["datagram.delay"], self:range(self.at, 4))
            self:skip(4, "delay")
            local len = self:byte("length of an acknowledgment")
            if len > 32 then
                malformed("acknowledgment is too long")
            end
            self:need(len, "acknowledgment")
            if len > 0 then
                item(branch, F["datagram.earlier"], self:range(self.at, len))
            end
            self:skip(len, "acknowledgment")
            info:add("acknowledgment to " .. largest)
        elseif kind == 2 then
            number(F.number, "number of the parcel")
            local text, problem = guarded(branch, parcel, self, branch, branch)
            info:add(text or "malformed parcel: " .. problem)
            self.at = self.stop
        elseif kind == 3 then
            local id = number(F.number, "number of the parcel")
            local len = self:byte("length of an answer")
            self:need(len, "answer")
            local text = answer(reader(self.tvb, self.at, self.at + len), branch)
            self:skip(len, "answer")
            info:add(("answer to %s: %s"):format(id, text))
        elseif kind == 4 then
            info:add("ping")
        elseif kind == 5 then
            info:add("skipped " .. number(F.number, "number of the parcel"))
        elseif kind == 6 then
            info:add("goodbye after " .. number(F.number, "number of the parcel"))
        else
            malformed("unknown frame " .. kind)
        end
        if branch then
            branch:set_len(self.at - start)
        end
    end
end

local function datagram_body(self, tree, kind, info)
    if kind == 6 then
        self:need(8, "number of the packet")
        return packet(self, tree, info)
    elseif kind == 1 or kind == 3 then
        self:need(8, "connection")
        item_le(tree, F["datagram.own"], self:range(self.at, 8))
        self:skip(8, "connection")
        if kind == 1 then
            self:need(16, "cookie")
            item(tree, F["datagram.cookie"], self:range(self.at, 16))
            self:skip(16, "cookie")
        end
        local text = counted_hello(self, tree)
        info:add(kind == 1 and text or text:gsub("^hello", "welcome"))
    elseif kind == 2 then
        self:need(16, "cookie")
        item(tree, F["datagram.cookie"], self:range(self.at, 16))
        info:add("cookie")
    elseif kind == 5 then
        self:need(8, "connection")
        item_le(tree, F["datagram.own"], self:range(self.at, 8))
        info:add("unknown connection")
    else
        info:add(DATAGRAM_KINDS[kind] or malformed("unknown kind of datagram " .. kind))
    end
end

local function datagram(tvb, pinfo, root)
    local size = tvb:len()
    items = 0
    local tree, info = root:add(fipa, tvb:range(0, size)), info_of()
    if size < DATAGRAM_HEADER then
        tree:add_proto_expert_info(E.malformed, "datagram is cut off")
        info:add("malformed datagram")
        info:show(pinfo)
        return size
    end
    item(tree, F.version, tvb:range(4, 1))
    item(tree, F["datagram.kind"], tvb:range(5, 1))
    item_le(tree, F.flags, tvb:range(6, 2))
    item_le(tree, F["datagram.to"], tvb:range(8, 8))
    local version, kind = tvb:range(4, 1):uint(), tvb:range(5, 1):uint()
    if version ~= VERSION then
        tree:add_proto_expert_info(E.note, "datagrams of version " .. version .. " are not dissected")
        info:add("datagram of version " .. version)
    else
        local self = reader(tvb, DATAGRAM_HEADER, size)
        local _, problem = guarded(tree, datagram_body, self, tree, kind, info)
        if problem then
            info:add("malformed datagram: " .. problem)
        end
    end
    tree:append_text(", " .. table.concat(info.parts, " | "))
    info:show(pinfo)
    return size
end

---------------------------------------------------------------------------------------------------------------------
-- Entries

-- Runs an entry. A fault of this file is shown as an item and does not end the dissection of other packets.
local function entry(work)
    return function(tvb, pinfo, root)
        if tvb:len() == 0 then
            return 0
        end
        local done, result = pcall(work, tvb, pinfo, root)
        if done then
            return result
        end
        local tree = root:add(fipa, tvb:range(0, tvb:len()))
        if is_malformed(result) then
            tree:add_proto_expert_info(E.malformed, result.problem)
        else
            tree:add_proto_expert_info(E.fault, "Fault of the dissector: " .. tostring(result))
        end
        return tvb:len()
    end
end

local dissect_stream, dissect_datagram, dissect_letters = entry(stream), entry(datagram), entry(letters)

-- Called for "Decode as", and for conversations that a heuristic has recognized.
function fipa.dissector(tvb, pinfo, root)
    if pinfo.port_type == UDP then
        return dissect_datagram(tvb, pinfo, root)
    end
    local first = tvb:len() > 0 and tvb:raw(0, 1):byte()
    if first == 0xfd or first == 0xfe then
        return dissect_letters(tvb, pinfo, root)
    end
    return dissect_stream(tvb, pinfo, root)
end

-- A protocol of its own, because the ports of QUIC are those of UDP.
streams_of_quic.dissector = dissect_stream

-- The message of a letter over HTTP, a part of a multipart body (FIPA00084).
function message_only.dissector(tvb, pinfo, root)
    if tvb:len() == 0 then
        return 0
    end
    items = 0
    local tree = root:add(fipa, tvb:range(0, tvb:len()))
    local info = info_of()
    info:add((show_message(tvb, tree, 0, tvb:len())))
    info:show(pinfo)
    return tvb:len()
end

local function is_stream(tvb)
    return tvb:len() >= COMMON and begins_frame(tvb, 0)
end

local function on_tcp(tvb, pinfo, root)
    if is_stream(tvb) then
        pinfo.conversation = fipa
        dissect_stream(tvb, pinfo, root)
        return true
    elseif begins_letter(tvb) then
        pinfo.conversation = fipa
        dissect_letters(tvb, pinfo, root)
        return true
    end
    return false
end

local function on_tls(tvb, pinfo, root)
    if not is_stream(tvb) then
        return false
    end
    dissect_stream(tvb, pinfo, root)
    return true
end

local function on_udp(tvb, pinfo, root)
    if tvb:len() < DATAGRAM_HEADER or not begins_frame(tvb, 0) then
        return false
    end
    dissect_datagram(tvb, pinfo, root)
    return true
end

fipa:register_heuristic("tcp", on_tcp)
fipa:register_heuristic("udp", on_udp)
fipa:register_heuristic("tls", on_tls)

-- Adds the dissector to a table of "Decode as", or to a table of protocol names. Versions of Wireshark have
-- different tables.
local function offer(name, pattern, dissector)
    local found, dissectors = pcall(DissectorTable.get, name)
    if not found or not dissectors then
        return
    end
    if pattern then
        dissectors:add(pattern, dissector)
    else
        dissectors:add_for_decode_as(dissector)
    end
end

offer("tcp.port", nil, fipa)
offer("udp.port", nil, fipa)
offer("tls.port", nil, fipa)
offer("quic.proto", "fipa/1", streams_of_quic)
offer("media_type", "application/text", message_only)

-- Appends to a session, or begins one: all of it or nothing, and only to the state the caller looked at.
-- KEYS: session (hash), history (string), steps (hash), all of one slot.
-- ARGV: version looked at ('' to begin), first byte to write, rows, step ('' for none), its answer, state,
--       config ('' where there is one already), time to live in ms.
-- Returns 1, or 0 where the session is no longer the one looked at.
if (redis.call('HGET', KEYS[1], 'version') or '') ~= ARGV[1] then
  return 0
end
-- A version tells apart two sessions of one id too: no other has this config.
local begun, n = string.match(ARGV[1], '^(%x+):(%d+)$')
if ARGV[1] == '' then
  begun = redis.sha1hex(ARGV[7])
end
redis.call('HSET', KEYS[1], 'version', (begun or '0') .. ':' .. (tonumber(n) or 0) + 1, 'state', ARGV[6])
if ARGV[7] ~= '' then
  redis.call('HSET', KEYS[1], 'config', ARGV[7])
end
if ARGV[3] ~= '' then
  redis.call('SETRANGE', KEYS[2], ARGV[2], ARGV[3])
end
if ARGV[4] ~= '' then
  redis.call('HSET', KEYS[3], ARGV[4], ARGV[5])
end
for _, key in ipairs(KEYS) do
  redis.call('PEXPIRE', key, ARGV[8])
end
return 1

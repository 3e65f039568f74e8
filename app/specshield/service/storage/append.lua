-- Appends to a session, or begins one: all of it or nothing, and only to the state the caller looked at.
-- KEYS: session (hash), rows (string), steps (list), all of one slot.
-- ARGV: version looked at ('' to begin), first byte to write, rows, step ('' for none), its record, state,
--       config ('' where it stays as it is), time to live in ms, 1 if replicas are waited for, else 0.
-- Returns the new version; where the session is no longer the one looked at, what there is instead:
--         {config, state, version, rows, what that step left}, each false where there is none.
if (redis.call('HGET', KEYS[1], 'version') or '') ~= ARGV[1] then
  local found = redis.call('HMGET', KEYS[1], 'config', 'state', 'version')
  found[4] = redis.call('GET', KEYS[2])
  found[5] = ARGV[4] ~= '' and redis.call('LINDEX', KEYS[3], ARGV[4])
  local left = redis.call('PTTL', KEYS[1])
  if ARGV[9] == '1' and left > 0 then
    redis.call('PEXPIRE', KEYS[1], left) -- so that WAIT waits (see FOLLOW in store.py)
  end
  return found
end
if tonumber(ARGV[2]) > redis.call('STRLEN', KEYS[2]) then
  return redis.error_reply('rows are missing before those to write') -- SETRANGE would make them of zeros
end
-- A version tells apart two sessions of one id too: no other has this config.
local begun, n = string.match(ARGV[1], '^(%x+):(%d+)$')
if ARGV[1] == '' then
  begun = redis.sha1hex(ARGV[7])
end
local version = (begun or '0') .. ':' .. (tonumber(n) or 0) + 1
redis.call('HSET', KEYS[1], 'version', version, 'state', ARGV[6])
if ARGV[7] ~= '' then
  redis.call('HSET', KEYS[1], 'config', ARGV[7])
end
if ARGV[3] ~= '' then
  redis.call('SETRANGE', KEYS[2], ARGV[2], ARGV[3])
end
if ARGV[4] ~= '' then
  for _ = redis.call('LLEN', KEYS[3]) + 1, ARGV[4] do
    redis.call('RPUSH', KEYS[3], '') -- a step that was passed over
  end
  redis.call('RPUSH', KEYS[3], ARGV[5])
end
for _, key in ipairs(KEYS) do
  redis.call('PEXPIRE', key, ARGV[8])
end
return version

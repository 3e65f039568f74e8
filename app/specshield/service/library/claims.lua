-- Whose the maps and policies are: ids on the disk, claimed by owners. All keys are of one slot.
-- KEYS: 1 what the owner claims of this kind {id: bytes}; 2 the owners of this id; 3 sums {o:owner | all: bytes,
-- kind: how many}; 4 the mark of an id that is being deleted; 5 the owner's policies on the map concerned
-- (this id, if it is a map); for a policy also 6 what the owner claims of maps; 7 the mark of its map;
-- 8 the owner's names of this kind {name: id}; 9 the same the other way round {id: name}; 10 what the owner
-- claims of policies; 11 what `all` counts for each id of this kind {id: bytes}, however many claim it.
-- ARGV: 1 what to do, 2 kind, 3 id, 4 owner, 5 token of a deletion, and for a claim 6 bytes, 7 most ids,
-- 8 most bytes of an owner, 9 most bytes of all, 10 the map's id ('' where it is everybody's); for a name 6 the name.
local what, kind, id, owner, token = ARGV[1], ARGV[2], ARGV[3], ARGV[4], ARGV[5]
local mine, held = 'o:' .. owner, tonumber(redis.call('HGET', KEYS[1], id))

local function sum(name) return tonumber(redis.call('HGET', KEYS[3], name)) or 0 end

local function count(bytes) -- in `all`, in place of what it counts for this id; an older version noted only claims
  redis.call('HINCRBY', KEYS[3], 'all', bytes - (tonumber(redis.call('HGET', KEYS[11], id)) or held or 0))
  redis.call('HSET', KEYS[11], id, bytes)
end

if what == 'claim' then
  local bytes, map = tonumber(ARGV[6]), ARGV[10]
  if redis.call('EXISTS', KEYS[4]) == 1 then return 'busy' end
  if held then return 'held' end
  if map ~= '' then
    if redis.call('EXISTS', KEYS[7]) == 1 then return 'busy' end
    if redis.call('HEXISTS', KEYS[6], map) == 0 then return 'no map' end
  end
  local first = redis.call('SCARD', KEYS[2]) == 0
  if first and sum(kind) >= tonumber(ARGV[7]) then return 'count' end
  if sum(mine) + bytes > tonumber(ARGV[8]) then return 'owner' end
  if first and sum('all') + bytes > tonumber(ARGV[9]) then return 'all' end
  redis.call('HSET', KEYS[1], id, bytes)
  redis.call('SADD', KEYS[2], owner)
  redis.call('HINCRBY', KEYS[3], mine, bytes)
  if map ~= '' then redis.call('SADD', KEYS[5], id) end
  if first then
    count(bytes)
    redis.call('HINCRBY', KEYS[3], kind, 1)
  end
  return 'made'
end

if what == 'name' then
  local bearer, former = redis.call('HGET', KEYS[8], ARGV[6]), redis.call('HGET', KEYS[9], id)
  if not held then return 'none' end
  if bearer and bearer ~= id then return bearer end
  if former and former ~= ARGV[6] then redis.call('HDEL', KEYS[8], former) end
  redis.call('HSET', KEYS[8], ARGV[6], id)
  redis.call('HSET', KEYS[9], id, ARGV[6])
  return 'named'
end

if what == 'mark' then
  if not held then return 'none' end
  if kind == 'maps' then
    for _, user in ipairs(redis.call('SMEMBERS', KEYS[5])) do
      if redis.call('HEXISTS', KEYS[10], user) == 1 then return user end
      redis.call('SREM', KEYS[5], user) -- deleted; an older version noted some policies on two maps
    end
  end
  return redis.call('SET', KEYS[4], token, 'NX', 'PX', 60000) and 'marked' or 'busy'
end

if what == 'free' then -- the mark of a last claim stays until the files are gone
  if not held or redis.call('GET', KEYS[4]) ~= token then return 'lost' end
  redis.call('HDEL', KEYS[1], id)
  redis.call('SREM', KEYS[2], owner)
  redis.call('HINCRBY', KEYS[3], mine, -held)
  if kind == 'policies' then redis.call('SREM', KEYS[5], id) end
  local name = redis.call('HGET', KEYS[9], id)
  if name then
    redis.call('HDEL', KEYS[8], name)
    redis.call('HDEL', KEYS[9], id)
  end
  if redis.call('SCARD', KEYS[2]) > 0 then
    redis.call('DEL', KEYS[4])
    return 'shared'
  end
  count(0)
  redis.call('HDEL', KEYS[11], id)
  redis.call('HINCRBY', KEYS[3], kind, -1)
  return 'last'
end

if what == 'weigh' then -- what the files take is known now
  if held then
    local bytes = tonumber(ARGV[6])
    redis.call('HSET', KEYS[1], id, bytes)
    redis.call('HINCRBY', KEYS[3], mine, bytes - held)
    count(bytes)
  end
  return 'done'
end

if redis.call('GET', KEYS[4]) == token then redis.call('DEL', KEYS[4]) end -- unmark
return 'done'

-- Lists a session's name, unless it is new and somebody has as many as they may.
-- KEYS: the list (sorted set). ARGV: the name; for each limit the first name and the last that count, and how many there may be.
-- Returns 0, or the number of the limit that is reached.
if not redis.call('ZSCORE', KEYS[1], ARGV[1]) then
  for i = 2, #ARGV, 3 do
    if redis.call('ZLEXCOUNT', KEYS[1], ARGV[i], ARGV[i + 1]) >= tonumber(ARGV[i + 2]) then
      return (i + 1) / 3
    end
  end
  redis.call('ZADD', KEYS[1], 0, ARGV[1])
end
return 0

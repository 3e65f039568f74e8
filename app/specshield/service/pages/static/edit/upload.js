// Makes the request that sends a map of the files that were dropped.

const ends = (file, ...kinds) => kinds.some((kind) => file.name.toLowerCase().endsWith(kind));

/** {form} or {json} for a POST to /v1/maps. Throws an Error that says which file is missing. */
export async function read(files, name) {
  const yaml = files.find((file) => ends(file, ".yaml", ".yml"));
  const image = files.find((file) => ends(file, ".pgm", ".png"));
  if (yaml && image) return { form: mapServer(yaml, image, name) };
  if (yaml || image) throw new Error(`With ${(yaml ?? image).name} goes ${yaml ? "its image (PGM or PNG)" : "its YAML"}: drop both together.`);
  const read = await Promise.all(files.filter((file) => ends(file, ".json")).map(parsed));
  if (!read.length) throw new Error("None of these files is a map: drop a YAML with its image, or JSON.");
  const body = ready(read);
  return { json: name ? { ...body, name } : body };
}

function mapServer(yaml, image, name) {
  const form = new FormData();
  form.append("metadata", yaml);
  form.append("image", image);
  if (name) form.append("name", name);
  return form;
}

async function parsed(file) {
  let value;
  try {
    value = JSON.parse(await file.text());
  } catch (error) {
    throw new Error(`${file.name} is not JSON: ${error.message}`);
  }
  if (value && typeof value === "object" && !Array.isArray(value)) return value;
  const kind = value === null ? "null" : Array.isArray(value) ? "a list" : `a ${typeof value}`;
  throw new Error(`${file.name} holds ${kind}: a map, and a list of asset sizes, is a JSON object with named members.`);
}

function ready(read) {
  const whole = read.find((value) => value.format);
  if (whole) return whole;
  const grid = read.find((value) => value.info && value.data);
  if (grid) return { format: "occupancy_grid", info: grid.info, data: grid.data };
  const house = read.find((value) => Array.isArray(value.rooms) && Array.isArray(value.walls));
  if (!house) throw new Error("The JSON is neither a ProcTHOR house (rooms and walls) nor an OccupancyGrid (info and data).");
  const sizes = read.find((value) => value !== house) ?? {};
  return { format: "procthor", house, asset_sizes: used(house, sizes) };
}

/** The sizes of the assets that a house uses, where they are known: the whole list is long. */
function used(house, sizes) {
  const wanted = new Set();
  const look = (value) => {
    if (Array.isArray(value)) value.forEach(look);
    else if (value && typeof value === "object") {
      if (typeof value.assetId === "string") wanted.add(value.assetId);
      Object.values(value).forEach(look);
    }
  };
  look(house);
  return Object.fromEntries(Object.entries(sizes).filter(([id]) => wanted.has(id)));
}

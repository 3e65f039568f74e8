// Names of regions: checks them, and changes them in the text of a rule.

const LONGEST = 64; // characters
const OPERATORS = ["F", "G", "U", "not", "always", "eventually", "until", "and", "or", "implies", "abs"];
const BODY = ["touches", "inside"]; // operators where a parenthesis follows; else the server reads them as names
const POSE = ["x", "y", "theta"];
const WORDS = /(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?|[A-Za-z_]\w*/g; // the numbers and words of a rule

/** Why a region or signal cannot have this name, as the end of a sentence; "" if it can.
 *  taken: the names of others. what: what these are.
 */
export function unfit(name, taken, what) {
  if (name === "") return "is empty: write at least one letter";
  if (name.length > LONGEST) return `has ${name.length} characters: at most ${LONGEST} are allowed`;
  if (!/^\w+$/.test(name)) return "cannot be a name: only letters a to z or A to Z, digits and _ are allowed";
  if (/^\d/.test(name)) return "cannot be a name: it begins with a digit; begin with a letter or _";
  if (OPERATORS.includes(name) || BODY.includes(name)) return "is a word of the language of rules: choose another name";
  if (POSE.includes(name)) return "stands for the robot's own pose in rules: choose another name";
  return taken.includes(name) ? `is the name of another ${what}: choose another name` : "";
}

/** The text of a rule in which a region has another name. Operators and numbers stay as they are. */
export function renamed(text, from, to) {
  if (OPERATORS.includes(from)) return text; // in the text it is an operator, never a name
  return text.replace(WORDS, (word, at) => {
    const operator = BODY.includes(word) && /^\s*\(/.test(text.slice(at + word.length));
    return word === from && !operator ? to : word;
  });
}

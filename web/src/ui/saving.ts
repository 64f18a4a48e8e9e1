const FILE = "labels.edit.json";

/** Writes edits back to the server that asked for them by a token, else downloads them; what was done. */
export async function save(json: string, token: string | null): Promise<string> {
  if (token === null) {
    download(json);
    return `${FILE} is downloaded; \`sagesplat labels apply RUN ${FILE}\` makes it so`;
  }
  const headers = { "content-type": "application/json", "x-sagesplat-token": token };
  const reply = await fetch(FILE, { method: "PUT", headers, body: json }).catch(() => null);
  if (!reply) throw new Error("The server cannot be reached; the edits are still here.");
  const text = (await reply.text()).trim();
  if (!reply.ok) throw new Error(text || `The server said ${reply.status}.`);
  return text;
}

/** The edits that the server has; null: none, or it takes none. */
export async function saved(token: string): Promise<string | null> {
  const reply = await fetch(FILE, { headers: { "x-sagesplat-token": token } }).catch(() => null);
  return reply?.ok ? reply.text() : null;
}

function download(json: string): void {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([json], { type: "application/json" }));
  link.download = FILE;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

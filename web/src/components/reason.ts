/** Why something did not come, in the page's words; what the site says of it is passed on as it is. */

import { MessageError } from "../api/checking";
import { ApiError, NoAnswer } from "../api/http";
import type { Text } from "../text";

export function reasonOf(error: unknown, { failures }: Text): string {
  if (error instanceof ApiError) return error.detail ?? failures.status(error.status);
  if (error instanceof NoAnswer) return failures[error.why];
  if (error instanceof MessageError) return failures.unexpected(error.path, error.found);
  if (error instanceof SyntaxError) return failures.noJson;
  return error instanceof Error ? error.message : String(error);
}

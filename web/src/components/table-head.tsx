/** The head of a table: a name for each column; one with buttons alone has none. */

export function TableHead({ names }: { names: readonly (string | null)[] }) {
  return (
    <thead>
      <tr>
        {names.map((name) =>
          name === null ? (
            <td key="" />
          ) : (
            <th key={name} scope="col">
              {name}
            </th>
          ),
        )}
      </tr>
    </thead>
  );
}

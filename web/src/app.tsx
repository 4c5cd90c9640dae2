/** The page: the plan, and beside it the machines and the recordings. */

import { Banners, Header } from "./components/header";
import { MachineList } from "./components/machine-list";
import { Recordings } from "./components/recordings";
import { Plan } from "./plan/plan";
import { useSpeech } from "./text";

export function App() {
  const { text } = useSpeech();
  return (
    <>
      <a class="skip" href="#machines">
        {text.page.skipToMachines}
      </a>
      <Header />
      <Banners />
      <main>
        <Plan />
        <div class="side">
          <MachineList />
          <Recordings />
        </div>
      </main>
    </>
  );
}

"""Rules of CSS that the page of a search has besides those of every page."""

STYLE = """
:root { --good: #1a7f4b; --bad: #b3261e; }
@media (prefers-color-scheme: dark) { :root { --good: #63c993; --bad: #ff8a80; } }
.page { grid-template-columns: 11rem minmax(0, 90rem); max-width: 106rem; }
.cards { display: grid; grid-template-columns: repeat(auto-fill, minmax(21rem, 1fr)); gap: 1rem; }
.card { display: flex; flex-direction: column; border: 1px solid var(--line); border-radius: .5rem;
  padding: .7rem .9rem; min-width: 0; scroll-margin-top: 1rem; }
.card:target { border-color: var(--accent); }
.card h3 { display: flex; flex-wrap: wrap; gap: .2rem .8rem; align-items: baseline;
  margin: 0 0 .6rem; color: var(--ink); font-weight: 400; }
.card h3 b { font-size: 1.15rem; font-weight: 650; }
.card .powers { font-variant-numeric: tabular-nums; letter-spacing: .06em; }
.card figure { margin-top: auto; }
.card figure svg { max-width: none !important; }
.card .bar { border-top: 2px solid currentColor; font-size: .75rem; color: var(--soft);
  margin: .3rem 0 .5rem; padding-top: .1rem; white-space: nowrap; }
.card dl { display: grid; grid-template-columns: auto 1fr; gap: .05rem .8rem; margin: 0;
  font-size: .85rem; font-variant-numeric: tabular-nums; }
.card dt { color: var(--soft); }
.card dd { margin: 0; overflow-wrap: anywhere; }
.links { display: flex; gap: .7rem; margin: .5rem 0 0; font-size: .85rem; }
.good { color: var(--good); } .bad { color: var(--bad); font-weight: 600; }
a { color: var(--accent); }
.notes { color: var(--soft); font-size: .85rem; padding-left: 1.1rem; }
@media (max-width: 60rem) { .page { grid-template-columns: minmax(0, 1fr); } }
"""

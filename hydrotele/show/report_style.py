"""The style of reports, for a screen of 1200 px and for A4 paper."""

STYLE = """
:root { --ink: #1d232b; --soft: #5c6672; --line: #dfe3e8; --pale: #f5f7f9;
  --before: #e07b00; --after: #1769aa; --good: #23794a; --bad: #b5281c; --unsure: #9a6700;
  --partly: #7b4aa3; }
* { box-sizing: border-box; }
html { -webkit-print-color-adjust: exact; print-color-adjust: exact; }
body { margin: 0; background: #fff; color: var(--ink); font: 15px/1.55 "Segoe UI", "Helvetica Neue",
  Helvetica, Arial, "Liberation Sans", sans-serif; }
main { max-width: 1120px; margin: 0 auto; padding: 40px 32px 64px; }
header { border-bottom: 3px solid var(--ink); padding-bottom: 20px; }
.over { color: var(--soft); font-size: 13px; letter-spacing: .04em; margin: 0 0 10px; }
h1 { font-size: 30px; line-height: 1.2; margin: 0 0 14px; font-weight: 650; }
h2 { font-size: 19px; margin: 44px 0 6px; font-weight: 650; break-after: avoid; }
h3 { font-size: 15px; margin: 22px 0 6px; font-weight: 650; break-after: avoid; }
p { margin: 6px 0; max-width: 82ch; }
.why { color: var(--soft); font-size: 13.5px; margin-bottom: 12px; }
.chip { display: inline-block; border-radius: 4px; padding: 3px 11px; color: #fff; font-size: 13px;
  font-weight: 650; letter-spacing: .02em; margin-bottom: 12px; }
.chip.named { background: var(--after); } .chip.no_gap { background: var(--good); }
.chip.partly { background: var(--partly); }
.chip.ambiguous { background: var(--unsure); } .chip.unknown { background: var(--bad); }
.verdict p { font-size: 16px; }
.figures { display: grid; grid-template-columns: repeat(4, 1fr); gap: 14px; margin: 26px 0 0; }
.figures div { background: var(--pale); border-left: 4px solid var(--line); padding: 12px 16px; }
.figures .before { border-color: var(--before); } .figures .after { border-color: var(--after); }
.figures b { display: block; font-size: 26px; line-height: 1.25; font-weight: 650;
  font-variant-numeric: tabular-nums; }
.figures span { color: var(--soft); font-size: 13px; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: 14px; margin: 8px 0 4px; }
th { text-align: left; color: var(--soft); font-weight: 600; font-size: 12.5px;
  border-bottom: 1.5px solid var(--ink); padding: 6px 10px; vertical-align: bottom; }
td { border-bottom: 1px solid var(--line); padding: 6px 10px; font-variant-numeric: tabular-nums; }
tr { break-inside: avoid; } thead { display: table-header-group; }
.n { text-align: right; white-space: nowrap; }
small { color: var(--soft); display: block; font-size: 12px; font-weight: 400; }
th b { color: var(--ink); }
table.laws td.r { text-align: center; white-space: nowrap; border-left: 1px solid #fff; }
table.laws th { text-align: left; } table.laws th.n { text-align: center; }
table.laws th:nth-child(even), table.laws td:nth-child(even) { padding-left: 14px; }
.yes { color: var(--good); font-weight: 650; } .no { color: var(--bad); font-weight: 650; }
.bar { background: var(--pale); height: 12px; min-width: 140px; }
.bar div { background: var(--after); height: 12px; min-width: 1px; }
svg { display: block; } svg .one { stroke: var(--soft); stroke-dasharray: 3 2; }
svg .way { stroke: #b9c2cc; stroke-width: 2.5; }
svg .scale { stroke: var(--line); stroke-width: 2; }
svg .before { fill: var(--before); } svg .after { fill: var(--after); }
svg .ci { fill: #8fbce2; } svg .model { stroke: var(--before); stroke-width: 3; }
.key { font-size: 13px; color: var(--soft); }
.key i { display: inline-block; width: 11px; height: 11px; border-radius: 50%;
  margin: 0 5px 0 12px; }
.key i.b { background: var(--before); margin-left: 0; } .key i.a { background: var(--after); }
figure { margin: 14px 0; break-inside: avoid; } img { width: 100%; height: auto; display: block; }
figcaption { color: var(--soft); font-size: 13px; }
pre { background: var(--pale); border-left: 4px solid var(--line); padding: 12px 16px;
  font: 12.5px/1.5 "DejaVu Sans Mono", Menlo, Consolas, monospace; overflow-x: auto;
  white-space: pre-wrap; break-inside: avoid-page; }
code { font: 13px "DejaVu Sans Mono", Menlo, Consolas, monospace; }
ul { margin: 6px 0; padding-left: 20px; }
footer { margin-top: 48px; border-top: 1px solid var(--line); padding-top: 12px;
  color: var(--soft); font-size: 13px; }
@media (max-width: 760px) { .figures { grid-template-columns: repeat(2, 1fr); } }
@page { size: A4; margin: 14mm 13mm; }
@media print {
  body { font-size: 10.5pt; } main { padding: 0; max-width: none; }
  h1 { font-size: 20pt; } h2 { margin-top: 22pt; } .wide { overflow: visible; }
  .figures { grid-template-columns: repeat(4, 1fr); gap: 8px; } td, th { padding: 3px 6px; }
  svg.interval { width: 100px; height: auto; } svg.dumbbell { width: 280px; height: auto; }
  .verdict p { font-size: 11pt; } table { font-size: 9pt; } .figures b { font-size: 17pt; }
}
"""

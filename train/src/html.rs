//! A report as one HTML page that needs nothing else: text, tables and pictures inside it.

use std::fmt::Write;

/// What every page looks like.
const STYLE: &str = "
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, sans-serif; color: #282c34; background: #fff; max-width: 1180px; margin: 2em auto; padding: 0 1.5em; }
h1 { font-size: 1.7em; margin-bottom: .2em; }
h2 { font-size: 1.25em; margin-top: 2em; border-bottom: 1px solid #d8dbe0; padding-bottom: .2em; }
p { max-width: 62em; }
code { background: #f2f3f5; padding: .1em .3em; border-radius: 3px; overflow-wrap: anywhere; }
.warning { background: #fff4e0; border-left: 4px solid #e68c1e; padding: .6em 1em; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; margin: .8em 0; }
th, td { padding: .3em .55em; border-bottom: 1px solid #e6e8eb; text-align: right; vertical-align: top; white-space: nowrap; }
th { background: #f6f7f8; white-space: normal; vertical-align: bottom; }
td:first-child, th:first-child { text-align: left; }
td.text, th.text { text-align: left; white-space: normal; }
small { display: block; color: #747a85; font-size: .82em; }
.good { color: #2c7a4b; } .bad { color: #b8372e; font-weight: 600; }
.figures { display: flex; flex-wrap: wrap; gap: 1em; }
figure { margin: .6em 0; max-width: 100%; }
figure svg, figure img { max-width: 100%; height: auto; display: block; }
figcaption { color: #555b66; font-size: .9em; max-width: 62em; }
";

/// The class of cells that hold words.
const WORDS: &str = "text";

/// A page under construction. All text that is given is shown as it is; nothing of it is read as HTML.
pub struct Page {
    title: String,
    body: String,
}

/// A cell of a table.
#[derive(Clone, Debug, Default)]
pub struct Cell {
    text: String,
    /// Smaller, under the text: an interval, a meaning.
    note: String,
    class: &'static str,
}

/// A picture.
#[derive(Clone, Debug)]
pub enum Picture {
    /// An SVG document.
    Svg(String),
    /// The bytes of a PNG file.
    Png(Vec<u8>),
}

impl<T: Into<String>> From<T> for Cell {
    fn from(text: T) -> Self {
        Self { text: text.into(), ..Self::default() }
    }
}

impl Cell {
    /// With a smaller line under it.
    pub fn note(mut self, note: impl Into<String>) -> Self {
        self.note = note.into();
        self
    }

    /// Words, which stand on the left and may be broken into lines.
    pub fn words(text: impl Into<String>) -> Self {
        Self { text: text.into(), class: WORDS, ..Self::default() }
    }

    /// Shown as good or bad.
    pub fn verdict(text: impl Into<String>, good: bool) -> Self {
        Self { text: text.into(), class: if good { "good" } else { "bad" }, ..Self::default() }
    }
}

impl Page {
    /// An empty page.
    pub fn new(title: &str) -> Self {
        Self { title: escape(title), body: format!("<h1>{}</h1>\n", escape(title)) }
    }

    /// Begins a section.
    pub fn section(&mut self, title: &str) {
        self.add(format_args!("<h2>{}</h2>\n", escape(title)));
    }

    /// A paragraph.
    pub fn text(&mut self, text: &str) {
        self.add(format_args!("<p>{}</p>\n", escape(text)));
    }

    /// A command or a path.
    pub fn code(&mut self, text: &str) {
        self.add(format_args!("<p><code>{}</code></p>\n", escape(text)));
    }

    /// What must not be overlooked.
    pub fn warning(&mut self, text: &str) {
        self.add(format_args!("<p class=\"warning\">{}</p>\n", escape(text)));
    }

    /// A table; the first column stands on the left, and so do heads of words.
    pub fn table(&mut self, head: &[&str], rows: &[Vec<Cell>]) {
        let class =
            |column: usize| rows.first().and_then(|r| r.get(column)).map_or("", |cell| if cell.class == WORDS { WORDS } else { "" });
        let heads = head.iter().enumerate().map(|(i, h)| format!("<th{}>{}</th>", attribute(class(i)), escape(h))).collect::<String>();
        let row = |row: &Vec<Cell>| format!("<tr>{}</tr>\n", row.iter().map(cell).collect::<String>());
        let rows: String = rows.iter().map(row).collect();
        self.add(format_args!("<div class=\"scroll\"><table>\n<tr>{heads}</tr>\n{rows}</table></div>\n"));
    }

    /// Pictures with their captions, side by side where there is room.
    pub fn figures(&mut self, figures: &[(Picture, &str)]) {
        let each: String = figures.iter().map(|(p, caption)| figure(p, caption)).collect();
        self.add(format_args!("<div class=\"figures\">\n{each}</div>\n"));
    }

    /// The whole document.
    pub fn finish(self) -> String {
        let head = "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n";
        let view = "<meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n";
        format!("{head}{view}<title>{}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n{}</body>\n</html>\n", self.title, self.body)
    }

    fn add(&mut self, text: std::fmt::Arguments) {
        // Writing to a string cannot fail.
        let _ = self.body.write_fmt(text);
    }
}

fn attribute(class: &str) -> String {
    if class.is_empty() { String::new() } else { format!(" class=\"{class}\"") }
}

fn cell(cell: &Cell) -> String {
    let class = attribute(cell.class);
    let note = if cell.note.is_empty() { String::new() } else { format!("<small>{}</small>", escape(&cell.note)) };
    format!("<td{class}>{}{note}</td>", escape(&cell.text))
}

fn figure(picture: &Picture, caption: &str) -> String {
    let caption = escape(caption);
    let shown = match picture {
        Picture::Svg(svg) => svg.clone(),
        Picture::Png(bytes) => format!("<img alt=\"{caption}\" src=\"data:image/png;base64,{}\">", base64(bytes)),
    };
    format!("<figure>{shown}<figcaption>{caption}</figcaption></figure>\n")
}

/// `text` with the characters that HTML gives a meaning written out.
fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;").replace('\'', "&#39;")
}

fn base64(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let group = |three: &[u8]| {
        let bits = three.iter().fold(0u32, |b, &x| b << 8 | u32::from(x)) << (8 * (3 - three.len()));
        let digit = |k: usize| if k > three.len() { '=' } else { DIGITS[(bits >> (18 - 6 * k) & 63) as usize] as char };
        [0, 1, 2, 3].map(digit)
    };
    bytes.chunks(3).flat_map(group).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn base64_of_the_standard() {
        // RFC 4648, section 10.
        for (plain, coded) in [("", ""), ("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foob", "Zm9vYg=="), ("foobar", "Zm9vYmFy")] {
            assert_eq!(base64(plain.as_bytes()), coded);
        }
        assert_eq!(base64(&[0xfb, 0xff]), "+/8=");
    }

    #[test]
    fn given_text_stays_text() {
        let mut page = Page::new("a < b");
        page.section("<script>");
        page.warning("\"quoted\" & 'so'");
        page.table(&["name", "value"], &[vec!["x".into(), Cell::from("1").note("0 > 2")], vec!["y".into(), Cell::verdict("2", false)]]);
        page.table(&["name", "why"], &[vec!["x".into(), Cell::words("<so>")]]);
        page.figures(&[(Picture::Png(b"foo".to_vec()), "<b>"), (Picture::Svg("<svg></svg>".into()), "plain")]);
        let html = page.finish();
        assert!(html.starts_with("<!doctype html>") && html.ends_with("</html>\n"));
        for want in [
            "<title>a &lt; b</title>",
            "<h2>&lt;script&gt;</h2>",
            "&quot;quoted&quot; &amp; &#39;so&#39;",
            "<td>1<small>0 &gt; 2</small></td>",
            "<td class=\"bad\">2</td>",
            "<th>value</th>",
            "<th class=\"text\">why</th></tr>\n<tr><td>x</td><td class=\"text\">&lt;so&gt;</td>",
            "src=\"data:image/png;base64,Zm9v\"",
            "<figure><svg></svg><figcaption>plain",
        ] {
            assert!(html.contains(want), "{want} in {html}");
        }
        assert!(!html.contains("<script") && !html.contains("http"));
    }
}

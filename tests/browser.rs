//! The map of the report and of `rowgram view`, driven in a browser.

use crate::program::rowgram;
use serde_json::{Value, json};
use std::{
    fs::{self, File},
    io::{BufRead, BufReader, Read, Write},
    net::TcpStream,
    path::Path,
    process::{Child, Command, Stdio},
    time::Duration,
};

/// The name of Chromium; says so where there is none.
fn browser() -> Option<&'static str> {
    let browsers = ["chromium", "chromium-browser", "google-chrome"];
    let is_there = |name: &&str| Command::new(name).arg("--version").output().is_ok();
    let browser = browsers.into_iter().find(is_there);
    if browser.is_none() {
        crate::data::tool_is_missing("Chromium");
    }
    browser
}

/// The page that headless Chromium makes of an address; says so where there is no browser.
fn shown(folder: &Path, address: &str) -> Option<String> {
    let browser = browser()?;
    let run = Command::new(browser)
        .args(["--headless", "--no-sandbox", "--disable-gpu", "--window-size=1200,900"])
        .arg(format!("--user-data-dir={}", folder.join("browser").display()))
        .args(["--virtual-time-budget=8000", "--dump-dom"])
        .arg(address)
        .output()
        .unwrap();
    assert!(!run.stdout.is_empty(), "{}", String::from_utf8_lossy(&run.stderr));
    Some(String::from_utf8_lossy(&run.stdout).into_owned())
}

/// Moves, zooms and asks the map of a report.
pub fn drive_map(folder: &Path, page: &str) {
    let driven = folder.join("driven.html");
    let script = include_str!("report_map.js");
    fs::write(&driven, format!("{page}<script>{script}</script>")).unwrap();
    let Some(dom) = shown(folder, &format!("file://{}", driven.display())) else { return };
    let seen = dom.split_once("data-seen=\"").and_then(|(_, rest)| rest.split_once('"'));
    let seen = seen.unwrap_or_else(|| panic!("the script has not ended: {dom}")).0;
    let seen: Value = serde_json::from_str(&percent_decoded(seen)).unwrap();
    assert!(seen["error"].is_null(), "{seen}");
    assert!(seen["colours"].as_u64().unwrap() > 20, "nothing is drawn: {seen}");
    assert!((seen["zoomed"].as_f64().unwrap() - 0.6_f64.exp()).abs() < 1e-3, "{seen}");
    assert!((seen["moved_px"].as_f64().unwrap() - 50.0).abs() < 1e-6, "{seen}");
    let text = |name: &str| seen[name].as_str().unwrap().to_owned();
    assert!(!text("after_drag").contains("place"), "a drag is no click: {seen}");
    let plant = text("plant");
    assert!(plant.contains(&format!("Plant {}", seen["plant_number"])), "{seen}");
    assert!(plant.contains("confidence") && plant.contains("row"), "{seen}");
    assert!(text("plot").contains(&format!("Plot {}", text("plot_name"))), "{seen}");
    assert!(text("plot").contains("canopy cover"), "{seen}");
    assert!(seen["whole"].as_bool().unwrap() && seen["key"].as_f64().unwrap() > 1.3, "{seen}");
}

/// A program that is ended when it goes out of scope.
pub struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A page in headless Chromium that is clicked and typed into, over the pipe of its debugger.
pub struct Page {
    _browser: Running,
    to: File,
    from: BufReader<File>,
    session: Option<String>,
    sent: u64,
}

impl Page {
    /// Opens an address; `None` where there is no browser.
    pub fn open(folder: &Path, address: &str) -> Option<Page> {
        let browser = browser()?;
        let [to, from] = ["to", "from"].map(|name| folder.join(name));
        assert!(Command::new("mkfifo").args([&to, &from]).status().unwrap().success());
        let child = Command::new("sh")
            .args(["-c", "exec \"$@\" 3<\"$TO\" 4>\"$FROM\"", "sh", browser])
            .args(["--headless", "--no-sandbox", "--disable-gpu", "--window-size=1500,950"])
            .arg(format!("--user-data-dir={}", folder.join("browser").display()))
            .arg("--remote-debugging-pipe")
            .env("TO", &to)
            .env("FROM", &from)
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let browser = Running(child);
        let to = File::options().write(true).open(to).unwrap();
        let from = BufReader::new(File::open(from).unwrap());
        let mut page = Page { _browser: browser, to, from, session: None, sent: 0 };
        let made = page.ask("Target.createTarget", &json!({"url": "about:blank"}));
        let attach = json!({"targetId": made["targetId"], "flatten": true});
        let session = page.ask("Target.attachToTarget", &attach);
        page.session = Some(session["sessionId"].as_str().unwrap().to_owned());
        page.go_to(address);
        Some(page)
    }

    /// Goes to an address.
    pub fn go_to(&mut self, address: &str) {
        self.ask("Page.navigate", &json!({"url": address}));
    }

    fn ask(&mut self, method: &str, parameters: &Value) -> Value {
        self.sent += 1;
        let mut message = json!({"id": self.sent, "method": method, "params": parameters});
        if let Some(session) = &self.session {
            message["sessionId"] = json!(session);
        }
        self.to.write_all(format!("{message}\0").as_bytes()).unwrap();
        loop {
            let mut answer = Vec::new();
            assert!(self.from.read_until(0, &mut answer).unwrap() > 0, "the browser has ended");
            answer.pop();
            let answer: Value = serde_json::from_slice(&answer).unwrap();
            if answer["id"] == json!(self.sent) {
                assert!(answer["error"].is_null(), "{method}: {answer}");
                return answer["result"].clone();
            }
        }
    }

    /// The value of an expression in the page.
    pub fn value(&mut self, expression: &str) -> Value {
        let parameters =
            json!({"expression": expression, "returnByValue": true, "awaitPromise": true});
        let answer = self.ask("Runtime.evaluate", &parameters);
        assert!(answer["exceptionDetails"].is_null(), "{expression}: {answer}");
        answer["result"]["value"].clone()
    }

    /// Waits until an expression is true; while a page is loaded it may not be known.
    pub fn wait(&mut self, expression: &str) {
        let careful =
            format!("(() => {{ try {{ return {expression} }} catch {{ return false }} }})()");
        for _ in 0..400 {
            if self.value(&careful) == json!(true) {
                return;
            }
            std::thread::sleep(Duration::from_millis(50));
        }
        let text = self.value("document.body.innerText");
        panic!("{expression} has not become true: {text}");
    }

    fn mouse(&mut self, what: &str, [x, y]: [f64; 2], more: &Value) {
        let mut event = json!({"type": what, "x": x, "y": y});
        more.as_object().unwrap().iter().for_each(|(key, value)| event[key] = value.clone());
        self.ask("Input.dispatchMouseEvent", &event);
    }

    /// Clicks on a place of the window.
    pub fn click(&mut self, at: [f64; 2]) {
        let button = json!({"button": "left", "clickCount": 1});
        self.mouse("mousePressed", at, &button);
        self.mouse("mouseReleased", at, &button);
    }

    /// Clicks on the middle of an element.
    pub fn click_on(&mut self, selector: &str) {
        let at = self.middle(selector);
        self.click(at);
    }

    /// Turns the wheel above the middle of an element.
    pub fn wheel(&mut self, selector: &str, delta: f64) {
        let at = self.middle(selector);
        self.mouse("mouseWheel", at, &json!({"deltaX": 0, "deltaY": delta}));
    }

    /// Where the middle of an element is in the window.
    pub fn middle(&mut self, selector: &str) -> [f64; 2] {
        let box_of = format!("document.querySelector({selector:?}).getBoundingClientRect()");
        let middle = format!("(b => [b.left + b.width / 2, b.top + b.height / 2])({box_of})");
        serde_json::from_value(self.value(&middle)).unwrap()
    }

    /// Presses a key; `modifiers` is 2 for Control and 8 for Shift.
    pub fn key(&mut self, key: &str, modifiers: u32) {
        for what in ["rawKeyDown", "keyUp"] {
            let event = json!({"type": what, "key": key, "modifiers": modifiers});
            self.ask("Input.dispatchKeyEvent", &event);
        }
    }
}

/// `rowgram view`, and the address that it says.
pub fn view(project: &Path) -> (Running, String) {
    let mut server = Running(
        Command::new(env!("CARGO_BIN_EXE_rowgram"))
            .arg("view")
            .arg(project)
            .arg("--json")
            .stdout(Stdio::piped())
            .spawn()
            .unwrap(),
    );
    let mut line = String::new();
    BufReader::new(server.0.stdout.take().unwrap()).read_line(&mut line).unwrap();
    let said: Value = serde_json::from_str(&line).unwrap();
    (server, said["url"].as_str().unwrap().to_owned())
}

/// What a server says to these bytes.
fn answer(address: &str, request: &str) -> Vec<u8> {
    let mut stream = TcpStream::connect(address).unwrap();
    // A connection that is reset has given its answer, or none.
    let _ = stream.write_all(request.as_bytes());
    let mut answer = Vec::new();
    let _ = stream.read_to_end(&mut answer);
    answer
}

/// The same as text.
fn ask_whole(address: &str, request: &str) -> String {
    String::from_utf8_lossy(&answer(address, request)).into_owned()
}

/// Status and body of it.
pub fn ask(address: &str, request: &str) -> (String, Vec<u8>) {
    let answer = answer(address, request);
    let end = answer.windows(4).position(|four| four == b"\r\n\r\n").unwrap_or(answer.len());
    let head = String::from_utf8_lossy(&answer[..end]).into_owned();
    let status = head.lines().next().unwrap_or_default().to_owned();
    (status, answer.get(end + 4..).unwrap_or_default().to_vec())
}

/// `rowgram view` serves every pixel of the map and the photos behind it, and nothing else.
pub fn assert_map_is_served(project: &Path) {
    let (_server, url) = view(project);
    let (address, token) =
        url.trim_start_matches("http://").trim_end_matches('/').split_once('/').unwrap();
    assert!(address.starts_with("127.0.0.1:"), "{url}");
    assert!(token.len() >= 32 && token.bytes().all(|b| b.is_ascii_hexdigit()), "{url}");
    let raw = |target: &str, more: &str| {
        ask(
            address,
            &format!("GET {target} HTTP/1.1\r\nHost: {address}\r\n{more}Connection: close\r\n\r\n"),
        )
    };
    let get = |target: &str| raw(&format!("/{token}{target}"), "");

    // The page runs nothing that stands in it, and nobody without the token has anything.
    let page = ask_whole(
        address,
        &format!("GET /{token}/ HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n"),
    );
    let policy =
        page.lines().find(|line| line.to_lowercase().starts_with("content-security-policy"));
    assert!(!policy.unwrap().contains("unsafe"), "{policy:?}");
    assert!(!page.contains(" style=\"") && !page.contains("<style"), "{page}");
    let wrong = "0".repeat(token.len());
    for target in [
        "/",
        "/tiles/0/0/0.jpg",
        &format!("/{wrong}/"),
        &format!("/{token}"),
        &format!("/{}/", &token[1..]),
    ] {
        assert!(raw(target, "").0.contains(" 404"), "{target}");
    }

    // A tile is what the orthomosaic is there.
    let ortho =
        rowgram::io::geotiff::Reader::open(&project.join("rowgram/ortho/ortho.tif")).unwrap();
    let (status, tile) = get("/tiles/0/1/1.jpg");
    assert!(status.contains(" 200"), "{status}");
    let tile = image::load_from_memory(&tile).unwrap().into_rgb8();
    let window = rowgram::raster::window::Window { u: 512, v: 512, width: 512, height: 512 };
    let pixels = ortho.read_rgb(window).unwrap();
    assert_eq!(tile.dimensions(), pixels.dimensions());
    let differences =
        tile.as_raw().iter().zip(pixels.as_raw()).map(|(a, b)| f64::from(a.abs_diff(*b)));
    let mean = differences.sum::<f64>() / tile.as_raw().len() as f64;
    assert!(mean < 6.0, "JPEG, but the same place: {mean}");

    // A plant, in every photo as `query` says.
    let table =
        rowgram::io::csv_table::CsvTable::read(&project.join("rowgram/locate/plants.csv")).unwrap();
    let column = |name: &str| table.numbers(name).unwrap()[table.len() / 2];
    let (u, v) = (column("u_px"), column("v_px"));
    let (status, found) = get(&format!("/photos?u={u}&v={v}"));
    assert!(status.contains(" 200"), "{status}");
    let found: Vec<Value> = serde_json::from_slice(&found).unwrap();
    assert!(found.len() >= 2, "{found:?}");
    assert_eq!(found.iter().filter(|of| of["is_source"] == true).count(), 1, "{found:?}");
    let [x, y] = ortho.georeference().unwrap().map([u, v]);

    // The raster itself, whole and in parts.
    let file = fs::read(project.join("rowgram/ortho/ortho.tif")).unwrap();
    let raster = format!("/{token}/rasters/ortho.tif");
    let (status, whole) = raw(&raster, "");
    assert!(status.contains(" 200") && whole == file, "{status}");
    let (status, part) = raw(&raster, "Range: bytes=100-299\r\n");
    assert!(status.contains(" 206") && part == file[100..300], "{status}");
    let (status, _) = raw(&raster, &format!("Range: bytes={}-\r\n", file.len()));
    assert!(status.contains(" 416"), "{status}");
    let parent = project.parent().unwrap();
    let name = project.file_name().unwrap().to_str().unwrap();
    let asked = rowgram(parent, &format!("ortho query {name} --at {x},{y} --every-photo --json"));
    let asked: Vec<Value> = serde_json::from_str(&asked.stdout).unwrap();
    assert_eq!(asked, found);
    let first = &found[0];
    let [number, column, row] = ["number", "u_px", "v_px"].map(|name| &first[name]);
    let (status, part) = get(&format!("/photos/{number}.jpg?u={column}&v={row}&side=80"));
    assert!(status.contains(" 200"), "{status}");
    assert!(image::load_from_memory(&part).is_ok());

    // Nothing else, whatever is asked.
    for target in [
        "/../../../../etc/passwd",
        "/%2e%2e/rowgram.toml",
        "/photos/9999.jpg?u=1&v=1&side=9",
        "/tiles/0/99999/0.jpg",
        "/photos?u=1e9&v=0",
        "/rowgram.toml",
    ] {
        let (status, body) = get(target);
        assert!(status.contains(" 404") || status.contains(" 400"), "{target}: {status}");
        assert!(body.len() < 300, "{target}");
        let said = String::from_utf8_lossy(&body);
        assert!(!said.contains(&*project.to_string_lossy()), "{target}: {said}");
    }
    let elsewhere = ask(
        address,
        &format!("GET /{token}/ HTTP/1.1\r\nHost: evil.example\r\nConnection: close\r\n\r\n"),
    );
    assert!(elsewhere.0.contains(" 403"), "{}", elsewhere.0);
    let written = ask(
        address,
        &format!(
            "PUT /{token}/ HTTP/1.1\r\nHost: {address}\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
        ),
    );
    assert!(written.0.contains(" 405"), "{}", written.0);
    // A body that is announced is neither made room for nor waited for, and heads have an end.
    for length in ["1000000000000000000", "10"] {
        let (status, _) = raw(&format!("/{token}/"), &format!("Content-Length: {length}\r\n"));
        assert!(status.contains(" 413"), "{length}: {status}");
    }
    let (status, _) = raw("/", &format!("X: {}\r\n", "x".repeat(1 << 20)));
    assert!(status.contains(" 431") || status.contains(" 400") || status.is_empty(), "{status}");
    // Clients that ask and never read, or never end their request, hold up nobody.
    let idle: Vec<TcpStream> = (0..24)
        .map(|k| {
            let mut stream = TcpStream::connect(address).unwrap();
            let request = format!("GET {raster} HTTP/1.1\r\nHost: {address}\r\n");
            stream.write_all(request.as_bytes()).unwrap();
            if k % 2 == 0 {
                stream.write_all(b"\r\n").unwrap();
            }
            stream
        })
        .collect();
    let begin = std::time::Instant::now();
    assert!(get("/tiles/0/0/0.jpg").0.contains(" 200"), "others are served meanwhile");
    assert!(begin.elapsed().as_secs() < 8, "{:?}", begin.elapsed());
    drop(idle);
    for broken in ["\r\n\r\n", "GET\r\n\r\n", "\u{0}\u{1}\r\n\r\n", "GET / HTTP/9.9\r\n\r\n"] {
        ask(address, broken);
    }
    drop(TcpStream::connect(address).unwrap());
    assert!(get("/").0.contains(" 200"), "it goes on after broken requests");

    // In a browser, at that plant.
    let folder = tempfile::tempdir().unwrap();
    let Some(dom) = shown(folder.path(), &format!("{url}#at={x},{y}")) else { return };
    assert!(dom.contains("<h3>Plant "), "the plant is chosen");
    assert_eq!(dom.matches("<figure>").count(), found.len().min(24));
    assert!(dom.contains("the map shows this one"));
}
/// What `encodeURIComponent` made.
fn percent_decoded(text: &str) -> String {
    let mut parts = text.split('%');
    let mut bytes = parts.next().unwrap().as_bytes().to_vec();
    for part in parts {
        bytes.push(u8::from_str_radix(&part[..2], 16).unwrap());
        bytes.extend(part[2..].bytes());
    }
    String::from_utf8(bytes).unwrap()
}
